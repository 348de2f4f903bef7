"""A plain 3D Gaussian Splatting PLY that any splat viewer opens, with class and instance of every Gaussian."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..model.baking import BakedGaussians

SH_DEGREE_0 = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic: colour = 0.5 + SH_DEGREE_0 * f_dc."""

_FLOATS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
           "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip
_VERTEX = np.dtype([*((name, "<f4") for name in _FLOATS), ("class_id", "<i4"), ("instance_id", "<i4")])


def write_ply(path: Path, splats: BakedGaussians) -> None:
    """Binary little endian, spherical harmonics of degree 0, opacity as logit, scale as logarithm. Raises
    OSError.
    """
    vertices = np.zeros(len(splats.means), _VERTEX)
    opacity = np.clip(splats.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    _set(vertices, ("x", "y", "z"), splats.means)
    _set(vertices, ("f_dc_0", "f_dc_1", "f_dc_2"), (splats.colours - 0.5) / SH_DEGREE_0)
    vertices["opacity"] = np.log(opacity / (1 - opacity))
    _set(vertices, ("scale_0", "scale_1", "scale_2"), np.log(np.maximum(splats.scales, 1e-9)))
    _set(vertices, ("rot_0", "rot_1", "rot_2", "rot_3"), splats.quats)
    vertices["class_id"], vertices["instance_id"] = splats.class_id, splats.instance_id
    kinds = {"<f4": "float", "<i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {kinds[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    write_atomically(path, "\n".join([*lines, "end_header\n"]).encode() + vertices.tobytes())


def _set(vertices: NDArray[np.void], names: tuple[str, ...], values: NDArray[np.floating]) -> None:
    for column, name in enumerate(names):
        vertices[name] = values[:, column]
