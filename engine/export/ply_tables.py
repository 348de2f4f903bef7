"""PLY files, binary little endian, of named columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically

_KINDS = {"f4": "float", "i4": "int", "u1": "uchar"}
_TRIANGLE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def write_ply_table(
    path: Path, columns: Mapping[str, NDArray[np.generic]], triangles: NDArray[np.integer] | None = None
) -> None:
    """Vertices of float32, int32 or uint8 columns [N], and triangles [T, 3] of them. Raises ValueError for columns of
    other types or of different lengths, OSError."""
    count = {len(values) for values in columns.values()}
    if len(count) != 1:
        raise ValueError(f"columns differ in length: {', '.join(columns)}")
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    unknown = [name for name, kind in kinds if kind.str[1:] not in _KINDS]
    if unknown:
        raise ValueError(f"the column {unknown[0]} is {columns[unknown[0]].dtype}, not float32, int32 or uint8")
    vertices = np.empty(count.pop(), np.dtype(kinds))
    for name, values in columns.items():
        vertices[name] = values
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {_KINDS[kind.str[1:]]} {name}" for name, kind in kinds]
    body = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), _TRIANGLE)
        faces["count"], faces["corners"] = 3, triangles
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    write_atomically(path, "\n".join([*lines, "end_header\n"]).encode() + body)
