"""The loops over sixteen Gaussians side by side: as vectors, and each for itself."""

from __future__ import annotations

import re
from typing import Any

import numba
import numpy as np
import pytest

from engine.machine.compiled import machine_target
from engine.raster.projection import backward, forward
from engine.raster.projection.lanes import LANES

CAMERA = np.linspace(0.5, 1.5, forward.CAMERA)


@numba.njit(error_model="numpy")
def project_all(camera: Any, block: Any) -> None:
    forward.project_block(camera, 64, 48, block)


@numba.njit(error_model="numpy")
def project_all_backward(camera: Any, block: Any) -> None:
    backward.project_block_backward(camera, block)


WAYS = [(project_all, forward.PROJECTION_BLOCK), (project_all_backward, backward.GRADIENT_BLOCK)]


def random_block(size: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 2.0, size)


@pytest.mark.skipif("+avx," not in machine_target()[2], reason="looks for instructions of AVX")
@pytest.mark.parametrize(("way", "size"), WAYS)
def test_llvm_makes_vectors_of_the_loop(way: Any, size: int) -> None:
    """A branch, or a call that is not inlined, and it goes through the lanes one by one."""
    way(CAMERA, random_block(size))
    (code,) = way.inspect_asm().values()
    assert re.search(r"vdivpd\s.*[yz]mm", code) and re.search(r"vsqrtpd\s.*[yz]mm", code)


@pytest.mark.parametrize(("way", "size"), WAYS)
def test_a_lane_is_the_same_whatever_the_others_hold(way: Any, size: int) -> None:
    block = random_block(size)
    alone = np.full(size, np.nan)
    alone[3::LANES] = block[5::LANES]
    way(CAMERA, block)
    way(CAMERA, alone)
    assert np.isfinite(block).all()
    np.testing.assert_array_equal(alone[3::LANES], block[5::LANES])
