"""Write Gaussians in formats other than PLY: SPZ, and glTF with KHR_gaussian_splatting. Both have y up."""

from __future__ import annotations

import gzip
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..passes.layers import linear
from ..passes.ply import SH_DEGREE_0
from .mesh import GlbBuffer, upright

_SPZ_MAGIC, _SPZ_VERSION, _FRACTIONAL_BITS = 0x5053474E, 3, 12  # positions: 24 bits, 1/4096 m, so within 2048 m
_SPZ_COLOUR = 0.15
_MOST_OF_THREE = float(np.sqrt(0.5))  # the largest value of the three smaller components of a unit quaternion
_EXTENSION = "KHR_gaussian_splatting"
_COLOUR_SPACE = "srgb_rec709_display"


def columns(rows: NDArray[np.void], names: str) -> NDArray[np.float32]:
    """Return the columns ``names`` (separated by blanks) of ``rows`` [N] of a splat file, float32 [N, K]."""
    return np.stack([rows[name] for name in names.split()], axis=1).astype(np.float32)


def opacities(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Return the opacity from 0 to 1 of each Gaussian, rows of a splat file, float32 [N]."""
    return (1 / (1 + np.exp(-rows["opacity"].astype(np.float64)))).astype(np.float32)


def unit_turns(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Return the rotations of Gaussians, rows of a splat file, as unit quaternions wxyz, float32 [N, 4]."""
    turns = columns(rows, "rot_0 rot_1 rot_2 rot_3")
    return turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), np.float32(1e-12))


def _upright_turns(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Return the rotations in a world with y up, as unit quaternions in the order x, y, z, w, float32 [N, 4]."""
    w, x, y, z = unit_turns(rows).T
    return np.float32(_MOST_OF_THREE) * np.stack([x - w, y + z, z - y, w + x], axis=1)


def spz_bytes(rows: NDArray[np.void]) -> bytes:
    """Return an SPZ file, version 3 (github.com/nianticlabs/spz): x right, y up, z backward, colours of degree 0."""
    steps = np.rint(upright(columns(rows, "x y z")).astype(np.float64) * (1 << _FRACTIONAL_BITS))
    whole = np.clip(steps, -(1 << 23), (1 << 23) - 1).astype("<i4")
    parts: list[NDArray[Any]] = [
        np.ascontiguousarray(whole).view(np.uint8).reshape(-1, 3, 4)[..., :3],
        _bytes(255 * opacities(rows)),
        _bytes(255 * (_SPZ_COLOUR * columns(rows, "f_dc_0 f_dc_1 f_dc_2") + 0.5)),
        _bytes(16 * (columns(rows, "scale_0 scale_1 scale_2") + 10)),  # SPZ's steps of a 16th, from e^-10 m on
        _smallest_three(_upright_turns(rows)),
    ]
    head = struct.pack("<IIIBBBB", _SPZ_MAGIC, _SPZ_VERSION, len(rows), 0, _FRACTIONAL_BITS, 0, 0)
    return gzip.compress(head + b"".join(part.tobytes() for part in parts), mtime=0)  # no time: repeatable bytes


LARGEST_OF_SPZ = 1 << (23 - _FRACTIONAL_BITS)
"""Metres: the largest coordinate that SPZ holds."""


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _smallest_three(turns: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Encode quaternions [N, 4] in 32 bits: 2 for the index of the largest component, the rest for the others."""
    largest = np.abs(turns).argmax(axis=1)
    # q and -q are one turn, so the largest can be positive, and need not be stored
    flipped = turns * np.where(np.take_along_axis(turns, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    magnitude = np.rint(511 * np.abs(flipped) / _MOST_OF_THREE).clip(0, 511).astype(np.uint32)
    for axis in range(4):
        value = magnitude[:, axis] | (flipped[:, axis] < 0).astype(np.uint32) << np.uint32(9)
        packed = np.where(largest == axis, packed, packed << np.uint32(10) | value)
    return packed.astype("<u4")


def splats_glb(rows: NDArray[np.void]) -> bytes:
    """Return a GLB with a points primitive and KHR_gaussian_splatting. COLOR_0 is for programs that draw points; the
    attributes _CLASS_ID and _INSTANCE_ID are ours. At least one Gaussian is required."""
    xyz, opacity, f_dc = upright(columns(rows, "x y z")), opacities(rows), columns(rows, "f_dc_0 f_dc_1 f_dc_2")
    colour = linear(np.clip(0.5 + np.float32(SH_DEGREE_0) * f_dc, 0, 1))
    arrays: dict[str, NDArray[Any]] = {
        "POSITION": xyz,
        "COLOR_0": np.concatenate([colour, opacity[:, None]], axis=1),
        f"{_EXTENSION}:ROTATION": _upright_turns(rows),
        f"{_EXTENSION}:SCALE": np.exp(columns(rows, "scale_0 scale_1 scale_2")),
        f"{_EXTENSION}:OPACITY": opacity,
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": f_dc,
        "_CLASS_ID": rows["class_id"],
        "_INSTANCE_ID": rows["instance_id"],
    }
    buffer = GlbBuffer()
    shown = {"kernel": "ellipse", "colorSpace": _COLOUR_SPACE}
    points = {"attributes": buffer.add_vertices(arrays), "mode": 0}
    mesh = {"name": "splats", "primitives": [points | {"extensions": {_EXTENSION: shown}}]}
    return buffer.file([{"name": "splats", "mesh": 0}], [mesh], {"extensionsUsed": [_EXTENSION]})
