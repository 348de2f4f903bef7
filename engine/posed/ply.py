"""Read PLY files that lifts write: Gaussians in the format of 3D Gaussian splatting, and the surface mesh.ply."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError, reading
from ..gates import read_plain

LEAST_TRIANGLES = 20  # meshes with fewer triangles are fragments, and are left out
_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_FACE: list[Any] = [("count", "u1"), ("corners", "<i4", 3)]
_TEXTURED = [*_FACE, ("values", "u1"), ("uv", "<f4", (3, 2))]
_COLUMNS = {"x", "y", "z", "red", "green", "blue", "class_id", "instance_id"}
_MOST_OF_SURFACE, _MOST_OF_SPLATS = 1 << 30, 4 << 30
_LONGEST_HEADER = 8192
_MESH_FIX, _SPLATS_FIX = "Delete the file, then make the meshes again.", "Lift the scene again."
_FARTHEST = 1e6  # metres, as for points
_WHOLE = {"class_id": "<i4", "instance_id": "<i4", "red": "u1", "green": "u1", "blue": "u1"}
"""Columns of splat files that hold whole numbers, whatever their declared type."""
_NEEDED = {"x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1",
           "rot_2", "rot_3"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class LabelledSurface:
    """A triangle mesh: ``xyz`` float32 [V, 3] metres, ``rgb`` uint8 [V, 3] sRGB, ``class_id`` and ``instance_id`` int32
    [V], ``triangles`` int32 [T, 3]. With textures, ``uv`` float32 [T, 3, 2] is where each corner lies in the picture of
    its (class, instance), as fractions from the lower left."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]
    triangles: NDArray[np.int32]
    uv: NDArray[np.float32] | None = None

    def parts(self) -> dict[tuple[int, int], NDArray[np.int64]]:
        """Return the rows [T] of each (class, instance)'s triangles (`rows_by_label`), without void and fragments."""
        found = rows_by_label(self.triangles, self.class_id.astype(np.int64) << 32 | self.instance_id)
        return {
            (label >> 32, label & 0xFFFFFFFF): rows
            for label, rows in found.items()
            if label >> 32 and len(rows) >= LEAST_TRIANGLES
        }

    def cut(self, rows: NDArray[np.int64]) -> LabelledSurface:
        """Return a mesh of the triangles in ``rows`` [T] and only their vertices."""
        used, corners = np.unique(self.triangles[rows], return_inverse=True)
        renumbered, uv = corners.reshape(-1, 3).astype(np.int32), None if self.uv is None else self.uv[rows]
        vertices = (self.xyz[used], self.rgb[used], self.class_id[used], self.instance_id[used])
        return LabelledSurface(*vertices, renumbered, uv)


def labels_of_triangles(triangles: NDArray[np.integer], label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles' labels [T] from vertices' labels [V]: the one that two corners share, else the first's."""
    corners = label[triangles]
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])


def rows_by_label(triangles: NDArray[np.integer], label: NDArray[np.int64]) -> dict[int, NDArray[np.int64]]:
    """Return the rows of the triangles [T, 3] of each label, from vertices' labels [V]; see `labels_of_triangles`."""
    own = labels_of_triangles(triangles, label)
    order = np.argsort(own, kind="stable")
    values, starts = np.unique(own[order], return_index=True)
    return dict(zip(values.tolist(), np.split(order, starts)[1:], strict=True))


def read_surface(path: Path) -> LabelledSurface:
    """The surface in a mesh.ply. Raises PlgsError for a file that holds none."""
    content, end, columns, (vertices, faces) = _read(path, _MOST_OF_SURFACE, _MESH_FIX)
    has_uv = b"\nproperty list uchar float texcoord\n" in content[:end]
    face = np.dtype(_TEXTURED if has_uv else _FACE)
    if not _COLUMNS <= {*columns}:
        raise PlgsError("not-labelled-surface", "this is not a labelled surface", path, _MESH_FIX)
    row = np.dtype([*columns.items()])
    if len(content) != end + vertices * row.itemsize + faces * face.itemsize:
        raise PlgsError("file-damaged", "the file is damaged", path, _MESH_FIX)
    table = np.frombuffer(content, row, vertices, end)
    drawn = np.frombuffer(content, face, faces, end + vertices * row.itemsize)
    triangles = drawn["corners"]
    if faces and not 0 <= int(triangles.min()) <= int(triangles.max()) < vertices:
        raise PlgsError("file-damaged", "the file is damaged", path, _MESH_FIX)
    return LabelledSurface(
        np.stack([table[axis] for axis in "xyz"], axis=1),
        np.stack([table[channel] for channel in ("red", "green", "blue")], axis=1),
        table["class_id"].astype(np.int32),
        table["instance_id"].astype(np.int32),
        np.ascontiguousarray(triangles),
        np.nan_to_num(drawn["uv"]) if has_uv else None,
    )


def read_gaussians(path: Path) -> NDArray[np.void]:
    """Read a splat file as a structured array [N] with a field per column. Rows with positions that are not finite or
    absurdly far away are left out. Ids are int32, colours uint8. Raises PlgsError for other files."""
    content, end, columns, (count, _) = _read(path, _MOST_OF_SPLATS, _SPLATS_FIX)
    if not _NEEDED <= {*columns}:
        raise PlgsError("no-splats", "the file holds no splats", path, _SPLATS_FIX)
    row = np.dtype([*columns.items()])
    if len(content) != end + count * row.itemsize:
        raise PlgsError("file-damaged", "the file is damaged", path, _SPLATS_FIX)
    rows = np.frombuffer(content, row, count, end)
    whole = {name: kind for name, kind in _WHOLE.items() if name in columns}
    is_sound = np.all([np.isfinite(rows[name]) for name in sorted({*_NEEDED, *whole})], axis=0)
    is_sound &= np.all([np.abs(rows[name]) <= _FARTHEST for name in "xyz"], axis=0)
    limits = {name: np.iinfo(np.dtype(kind)) for name, kind in whole.items()}
    is_sound &= np.all([(rows[name] >= of.min) & (rows[name] < of.max + 1) for name, of in limits.items()], axis=0)
    return (rows if is_sound.all() else rows[is_sound]).astype([*(columns | whole).items()])


def left_out(path: Path) -> int:
    """Return how many rows of a splat file `read_gaussians` leaves out. Raises PlgsError for other files."""
    return _read(path, _MOST_OF_SPLATS, _SPLATS_FIX)[3][0] - len(read_gaussians(path))


def _read(path: Path, most_bytes: int, fix: str) -> tuple[bytes, int, dict[str, str], tuple[int, int]]:
    """Read a PLY: its bytes, where its header ends, the types of the vertices' columns by name (none if the file is of
    another kind or repeats a name), and the numbers of vertices and faces. Raises PlgsError with ``fix`` as advice."""
    with reading(path, fix):
        content = read_plain(path, most_bytes)
    header = ply_header(content, _LONGEST_HEADER)
    vertices, columns = header.elements.get("vertex", (0, {}))
    faces, _ = header.elements.get("face", (0, {}))
    is_ours = header.form == "binary_little_endian" and "" not in columns.values()
    columns = {name: f"<{kind}" for name, kind in columns.items()} if is_ours else {}
    return content, header.end, columns, (vertices, faces)


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY, in its ``form`` (ascii, binary). ``end`` is where the data begins, 0 if the file is no PLY.
    ``elements`` holds for each kind of element the count and the numpy types of properties by name, "" for lists,
    unknown types and repeated names."""

    form: str
    end: int
    elements: dict[str, tuple[int, dict[str, str]]]


def ply_header(data: bytes, longest: int | None = None) -> PlyHeader:
    """Parse a PLY's header, which is searched for in the first ``longest`` bytes of ``data``."""
    form, elements, columns = "", dict[str, tuple[int, dict[str, str]]](), dict[str, str]()
    last = data.find(b"end_header", 0, longest) if data.startswith(b"ply") else -1
    end = data.find(b"\n", last) + 1 if last >= 0 else 0
    for line in data[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", name, *_]:
                form = name
            case ["element", name, count] if count.isdecimal():
                elements[name] = int(count), (columns := {})
            case ["property", kind, *_, name]:
                columns[name] = "" if name in columns else _KINDS.get(kind, "")  # empty: twice, or a list
    return PlyHeader(form, end, elements)
