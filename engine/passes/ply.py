"""Write PLY files, binary little endian: tables of named columns, and splats that viewers of 3DGS open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically

if TYPE_CHECKING:  # tables are also written without torch
    from ..model.baking import BakedGaussians

SH_DEGREE_0 = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic: colour = 0.5 + SH_DEGREE_0 * f_dc."""
_KINDS = {"f4": "float", "i4": "int", "u1": "uchar"}
_TRIANGLE: list[Any] = [("count", "u1"), ("corners", "<i4", 3)]
_TEXTURED = [*_TRIANGLE, ("values", "u1"), ("uv", "<f4", (3, 2))]


def columns_of(names: str, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of ``values`` [N, K] by the K ``names``, which are separated by spaces."""
    return dict(zip(names.split(), values.T, strict=True))


def write_ply_table(
    path: Path,
    columns: Mapping[str, NDArray[Any]],
    triangles: NDArray[np.integer] | None = None,
    comment: str = "",
    uv: NDArray[np.float32] | None = None,
) -> None:
    """Write vertices of float32, int32 or uint8 columns [N], and triangles [T, 3] of them, with their corners' texture
    coordinates ``uv`` [T, 3, 2], and a comment. Raises ValueError for columns of other types or lengths; OSError."""
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
    comments = [f"comment {comment}"] if comment else []
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {len(vertices)}"]
    lines += [f"property {_KINDS[kind.str[1:]]} {name}" for name, kind in kinds]
    body = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), _TRIANGLE if uv is None else _TEXTURED)
        faces["count"], faces["corners"] = 3, triangles
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        if uv is not None:
            faces["values"], faces["uv"] = 6, uv
            lines.append("property list uchar float texcoord")
        body += faces.tobytes()
    write_atomically(path, "\n".join([*lines, "end_header\n"]).encode() + body)


def write_splats(path: Path, splats: BakedGaussians) -> None:
    """Write splats with spherical harmonics of degree 0, opacity as logit, scale as logarithm; class and instance of
    every Gaussian, and its blended colour as red, green and blue. All are floats, as other readers refuse files with
    columns of other types. Raises OSError."""
    opacity = np.clip(splats.opacities.astype(np.float64), 1e-6, 1 - 1e-6)  # so that logits are finite
    floats = {
        **columns_of("x y z", splats.means),
        **columns_of("nx ny nz", np.zeros_like(splats.means)),  # unused, but the format of the authors has them
        **columns_of("f_dc_0 f_dc_1 f_dc_2", (splats.colours - 0.5) / SH_DEGREE_0),
        "opacity": np.log(opacity / (1 - opacity)),
        **columns_of("scale_0 scale_1 scale_2", np.log(np.maximum(splats.scales, 1e-9))),
        **columns_of("rot_0 rot_1 rot_2 rot_3", splats.quats),
    }
    blended = columns_of("red green blue", np.rint(255 * np.clip(splats.blended_colours(), 0, 1)))
    labels = {"class_id": splats.class_id, "instance_id": splats.instance_id}
    columns = {name: column.astype(np.float32) for name, column in (floats | labels | blended).items()}
    write_ply_table(path, columns)
