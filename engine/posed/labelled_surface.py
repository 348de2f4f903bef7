"""The lifted surface with a class and an instance at each vertex, as `engine export --to mesh` writes it to mesh.ply.
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
_MOST_BYTES = 1 << 30
_LONGEST_HEADER = 8192
_FIX = "Delete it, then make the meshes again."


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
    corners share, else that of its first corner.
    """
    corners = label[triangles]
    own = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    order = np.argsort(own, kind="stable")
    values, starts = np.unique(own[order], return_index=True)
    return dict(zip(values.tolist(), np.split(triangles[order], starts)[1:], strict=True))


def read_surface(path: Path) -> LabelledSurface:
    """The surface in a mesh.ply. Raises PlgsError for a file that holds none."""
    try:
        content = read_plain(path, _MOST_BYTES)
    except OSError as error:
        raise PlgsError(f"the file cannot be read ({error.strerror})", path, _FIX) from error
    end = content.find(b"end_header\n", 0, _LONGEST_HEADER) + len(b"end_header\n")
    columns, vertices, faces = _header(content[:end])
    if not content.startswith(b"ply\nformat binary_little_endian") or not _COLUMNS <= {name for name, _ in columns}:
        raise PlgsError("this is not a labelled surface", path, _FIX)
    row = np.dtype(columns)
    if len(content) != end + vertices * row.itemsize + faces * _FACE.itemsize:
        raise PlgsError("the file is damaged", path, _FIX)
    table = np.frombuffer(content, row, vertices, end)
    triangles = np.frombuffer(content, _FACE, faces, end + vertices * row.itemsize)["corners"]
    if faces and not 0 <= int(triangles.min()) <= int(triangles.max()) < vertices:
        raise PlgsError("the file is damaged", path, _FIX)
    return LabelledSurface(
        np.stack([table[axis] for axis in "xyz"], axis=1),
        np.stack([table[channel] for channel in ("red", "green", "blue")], axis=1),
        table["class_id"].astype(np.int32),
        table["instance_id"].astype(np.int32),
        np.ascontiguousarray(triangles),
    )


def _header(content: bytes) -> tuple[list[tuple[str, str]], int, int]:
    """The vertices' columns, and the numbers of vertices and faces."""
    columns, counts = [], {"vertex": 0, "face": 0}
    for line in content.decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", name, count] if name in counts and count.isdecimal():
                counts[name] = int(count)
            case ["property", kind, name] if kind in _KINDS:
                columns.append((name, _KINDS[kind]))
    return columns, counts["vertex"], counts["face"]
