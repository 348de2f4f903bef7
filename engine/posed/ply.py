"""PLY files that lifts write: Gaussians, whose format other programs use too, and the surface in mesh.ply.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..gates import read_plain

LEAST_TRIANGLES = 20
"""Meshes of fewer triangles are fragments and are left out."""
_KINDS = {"float": "<f4", "int": "<i4", "uchar": "u1"}
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_COLUMNS = {"x", "y", "z", "red", "green", "blue", "class_id", "instance_id"}
_MOST_OF_SURFACE, _MOST_OF_SPLATS = 1 << 30, 4 << 30
_LONGEST_HEADER = 8192
_MESH_FIX, _SPLATS_FIX = "Delete it, then make the meshes again.", "Lift the scene again."
_FARTHEST = 1e6
"""Metres, as for points."""
_NEEDED = {"x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1",
           "rot_2", "rot_3"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class LabelledSurface:
    """``xyz`` float32 [V, 3] metres, ``rgb`` uint8 [V, 3] sRGB, ``class_id`` and ``instance_id`` int32 [V],
    ``triangles`` int32 [T, 3]."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]
    triangles: NDArray[np.int32]

    def parts(self) -> dict[tuple[int, int], NDArray[np.int32]]:
        """The triangles [T, 3] of each (class, instance), as `triangles_by_label`. Void and fragments are left out."""
        found = triangles_by_label(self.triangles, self.class_id.astype(np.int64) << 32 | self.instance_id)
        return {
            (label >> 32, label & 0xFFFFFFFF): triangles
            for label, triangles in found.items()
            if label >> 32 and len(triangles) >= LEAST_TRIANGLES
        }

    def cut(self, triangles: NDArray[np.int32]) -> LabelledSurface:
        """The vertices of these triangles, and the triangles between them."""
        used, corners = np.unique(triangles, return_inverse=True)
        renumbered = corners.reshape(-1, 3).astype(np.int32)
        return LabelledSurface(self.xyz[used], self.rgb[used], self.class_id[used], self.instance_id[used], renumbered)


def triangles_by_label(
    triangles: NDArray[np.integer], label: NDArray[np.int64]
) -> dict[int, NDArray[Any]]:
    """The triangles [T, 3] of each label, from the labels [V] of the vertices. A triangle has the label that two of its
    corners share, else that of its first corner."""
    corners = label[triangles]
    own = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    order = np.argsort(own, kind="stable")
    values, starts = np.unique(own[order], return_index=True)
    return dict(zip(values.tolist(), np.split(triangles[order], starts)[1:], strict=True))


def read_surface(path: Path) -> LabelledSurface:
    """The surface in a mesh.ply. Raises PlgsError for a file that holds none."""
    content, end, columns, (vertices, faces) = _read(path, _MOST_OF_SURFACE, _MESH_FIX)
    if not _COLUMNS <= {*columns}:
        raise PlgsError("not-labelled-surface", "this is not a labelled surface", path, _MESH_FIX)
    row = np.dtype([*columns.items()])
    if len(content) != end + vertices * row.itemsize + faces * _FACE.itemsize:
        raise PlgsError("file-damaged", "the file is damaged", path, _MESH_FIX)
    table = np.frombuffer(content, row, vertices, end)
    triangles = np.frombuffer(content, _FACE, faces, end + vertices * row.itemsize)["corners"]
    if faces and not 0 <= int(triangles.min()) <= int(triangles.max()) < vertices:
        raise PlgsError("file-damaged", "the file is damaged", path, _MESH_FIX)
    return LabelledSurface(
        np.stack([table[axis] for axis in "xyz"], axis=1),
        np.stack([table[channel] for channel in ("red", "green", "blue")], axis=1),
        table["class_id"].astype(np.int32),
        table["instance_id"].astype(np.int32),
        np.ascontiguousarray(triangles),
    )


def read_gaussians(path: Path) -> NDArray[np.void]:
    """The rows of a splat file, a structured array [N] by its columns' names. Raises PlgsError for other files. Rows
    with numbers that are not finite, or that lie absurdly far away, are left out."""
    content, end, columns, (count, _) = _read(path, _MOST_OF_SPLATS, _SPLATS_FIX)
    if not _NEEDED <= {*columns}:
        raise PlgsError("no-splats", "the file holds no splats", path, _SPLATS_FIX)
    row = np.dtype([*columns.items()])
    if len(content) != end + count * row.itemsize:
        raise PlgsError("file-damaged", "the file is damaged", path, _SPLATS_FIX)
    rows = np.frombuffer(content, row, count, end)
    is_sound = np.all([np.isfinite(rows[name]) for name in sorted(_NEEDED)], axis=0)
    is_sound &= np.all([np.abs(rows[name]) <= _FARTHEST for name in "xyz"], axis=0)
    return rows if is_sound.all() else rows[is_sound]


def _read(path: Path, most_bytes: int, fix: str) -> tuple[bytes, int, dict[str, str], tuple[int, int]]:
    """A file's bytes, where its header ends, the vertices' columns, and the numbers of vertices and faces. There are no
    columns in a file of another kind, nor where a name occurs twice. Raises PlgsError, with ``fix`` as the advice."""
    try:
        content = read_plain(path, most_bytes)
    except OSError as error:
        raise PlgsError("unreadable", f"the file cannot be read ({error.strerror})", path, fix) from error
    end = content.find(b"end_header\n", 0, _LONGEST_HEADER) + len(b"end_header\n")
    columns, counts, properties = dict[str, str](), {"vertex": 0, "face": 0}, 0
    for line in content[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", name, count] if name in counts and count.isdecimal():
                counts[name] = int(count)
            case ["property", kind, name]:
                properties += 1
                columns[name] = _KINDS.get(kind, "")
    is_ours = content.startswith(b"ply\nformat binary_little_endian") and "" not in columns.values()
    columns = columns if is_ours and len(columns) == properties else {}
    return content, end, columns, (counts["vertex"], counts["face"])
