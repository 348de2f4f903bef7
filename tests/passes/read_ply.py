"""The inverse of ``write_splats``: the oracle of its tests."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.model.baking import BakedGaussians
from engine.passes.ply import SH_DEGREE_0

_OF_OTHERS = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
_VERTEX = np.dtype([(name, "<f4") for name in f"{_OF_OTHERS} class_id instance_id red green blue".split()])


def read_ply(path: Path) -> BakedGaussians:
    """For the files of ``write_splats`` only."""
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property ")]
    assert mark and lines[:2] == ["ply", "format binary_little_endian 1.0"] and names == list(_VERTEX.names or ())
    vertices = np.frombuffer(body, _VERTEX)
    return BakedGaussians(
        means=_get(vertices, ("x", "y", "z")),
        scales=np.exp(_get(vertices, ("scale_0", "scale_1", "scale_2"))),
        quats=_get(vertices, ("rot_0", "rot_1", "rot_2", "rot_3")),
        opacities=1 / (1 + np.exp(-vertices["opacity"])),
        colours=0.5 + np.float32(SH_DEGREE_0) * _get(vertices, ("f_dc_0", "f_dc_1", "f_dc_2")),
        class_id=vertices["class_id"].astype(np.int32),
        instance_id=vertices["instance_id"].astype(np.int32),
    )


def _get(vertices: NDArray[np.void], names: tuple[str, ...]) -> NDArray[np.float32]:
    return np.stack([vertices[name] for name in names], axis=-1).astype(np.float32)
