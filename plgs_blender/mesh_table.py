"""Reading mesh.ply, the lifted surface as `engine export --to mesh` writes it. Plain numpy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..engine.gates import read_plain
from ..engine.job import JobError

LEAST_TRIANGLES = 20
"""A mesh of fewer is fragments."""
_KINDS = {"float": "<f4", "int": "<i4", "uchar": "u1"}
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_COLUMNS = {"x", "y", "z", "red", "green", "blue", "class_id", "instance_id"}
_MOST_BYTES = 1 << 30
_LONGEST_HEADER = 8192
_FIX = "Delete it, and make the meshes anew."


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
        """The triangles [T, 3] of each (class, instance): that of two corners, else the first's. None of void, and no
        fragments."""
        label = self.class_id.astype(np.int64) << 32 | self.instance_id
        corners = label[self.triangles]
        own = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
        order = np.argsort(own, kind="stable")
        values, starts = np.unique(own[order], return_index=True)
        found = {}
        for value, triangles in zip(values.tolist(), np.split(self.triangles[order], starts[1:]), strict=True):
            if value >> 32 and len(triangles) >= LEAST_TRIANGLES:
                found[value >> 32, value & 0xFFFFFFFF] = triangles
        return found

    def cut(self, triangles: NDArray[np.int32]) -> LabelledSurface:
        """The vertices of these triangles, and the triangles between them."""
        used, corners = np.unique(triangles, return_inverse=True)
        renumbered = corners.reshape(-1, 3).astype(np.int32)
        return LabelledSurface(self.xyz[used], self.rgb[used], self.class_id[used], self.instance_id[used], renumbered)


def read_surface(path: Path) -> LabelledSurface:
    """Raises JobError for a file that is no such surface."""
    try:
        content = read_plain(path, _MOST_BYTES)
    except OSError as error:
        raise JobError(f"cannot be read ({error.strerror})", path, _FIX) from error
    end = content.find(b"end_header\n", 0, _LONGEST_HEADER) + len(b"end_header\n")
    columns, vertices, faces = _header(content[:end])
    if not content.startswith(b"ply\nformat binary_little_endian") or not _COLUMNS <= {name for name, _ in columns}:
        raise JobError("is no labelled surface", path, _FIX)
    row = np.dtype(columns)
    if len(content) != end + vertices * row.itemsize + faces * _FACE.itemsize:
        raise JobError("is damaged", path, _FIX)
    table = np.frombuffer(content, row, vertices, end)
    triangles = np.frombuffer(content, _FACE, faces, end + vertices * row.itemsize)["corners"]
    if faces and not 0 <= int(triangles.min()) <= int(triangles.max()) < vertices:
        raise JobError("is damaged", path, _FIX)
    return LabelledSurface(
        np.stack([table[axis] for axis in "xyz"], axis=1),
        np.stack([table[channel] for channel in ("red", "green", "blue")], axis=1),
        table["class_id"].astype(np.int32),
        table["instance_id"].astype(np.int32),
        np.ascontiguousarray(triangles),
    )


def _header(content: bytes) -> tuple[list[tuple[str, str]], int, int]:
    """The vertices' columns, and how many vertices and faces there are."""
    columns, counts = [], {"vertex": 0, "face": 0}
    for line in content.decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", name, count] if name in counts and count.isdecimal():
                counts[name] = int(count)
            case ["property", kind, name] if kind in _KINDS:
                columns.append((name, _KINDS[kind]))
    return columns, counts["vertex"], counts["face"]
