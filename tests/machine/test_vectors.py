"""Sixteen float32 at a time: the vector operations do what NumPy does."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from engine.machine.vector_shuffles import (
    deinterleave2,
    deinterleave3,
    horizontal_max,
    horizontal_sums,
    interleave2,
    interleave3,
)
from engine.machine.vectors import WIDTH, exp2, exp2_x4, load, load_pairs, store

A = np.random.default_rng(0).normal(size=3 * WIDTH).astype(np.float32)


def apply(function: Any, values: np.ndarray, results: int) -> np.ndarray:
    """The results that a function of a flat array writes to another one, vector by vector."""
    out = np.zeros(results * WIDTH, np.float32)
    numba.njit(function)(values, out)
    return out.reshape(results, WIDTH)


def test_rows_are_zipped_to_patches_and_back() -> None:
    def zip_and_back(values: Any, out: Any) -> None:
        left, right = interleave2(load(values, 0), load(values, 16))
        store(out, 0, left)
        store(out, 16, right)
        upper, lower = deinterleave2(left, right)
        store(out, 32, upper)
        store(out, 48, lower)

    found = apply(zip_and_back, A, 4)
    upper, lower = A[:16], A[16:32]
    assert np.array_equal(found[:2].ravel(), np.stack([upper, lower], 1).ravel())
    assert np.array_equal(found[2], upper) and np.array_equal(found[3], lower)


def test_planes_are_interleaved_to_pixels_and_back() -> None:
    def interleave_and_back(values: Any, out: Any) -> None:
        first, second, third = interleave3(load(values, 0), load(values, 16), load(values, 32))
        store(out, 0, first)
        store(out, 16, second)
        store(out, 32, third)
        red, green, blue = deinterleave3(first, second, third)
        store(out, 48, red)
        store(out, 64, green)
        store(out, 80, blue)

    found = apply(interleave_and_back, A, 6)
    assert np.array_equal(found[:3].ravel(), A.reshape(3, 16).T.ravel())
    assert np.array_equal(found[3:].ravel(), A)


def test_pairs_alternate_and_lanes_are_summed_up() -> None:
    def reduce(values: Any, out: Any) -> None:
        store(out, 0, load_pairs(values, 5))
        store(out, 16, horizontal_sums((load(values, 0), load(values, 16), load(values, 32))))
        out[32] = horizontal_max(load(values, 0))

    found = apply(reduce, A, 3)
    assert np.array_equal(found[0], np.tile(A[5:7], 8))
    assert np.allclose(found[1, :3], A.reshape(3, 16).sum(1), rtol=1e-5, atol=1e-5) and not found[1, 3:].any()
    assert found[2, 0] == A[:16].max()


@pytest.mark.parametrize("span", [(-63.9, 126.9), (-8.0, 0.0), (-1e-3, 1e-3)])
def test_powers_of_two(span: tuple[float, float]) -> None:
    def power(values: Any, out: Any) -> None:
        for number in range(4):
            store(out, 16 * number, exp2(load(values, 16 * number)))
        a, b, c, d = exp2_x4(load(values, 0), load(values, 16), load(values, 32), load(values, 48))
        store(out, 64, a)
        store(out, 80, b)
        store(out, 96, c)
        store(out, 112, d)

    exponents = np.linspace(*span, 4 * WIDTH).astype(np.float32)
    found = apply(power, exponents, 8).reshape(2, -1)
    assert np.array_equal(found[0], found[1])  # one or four: the two passes must agree on every bit
    assert np.allclose(found[0], np.exp2(exponents.astype(np.float64)), rtol=3e-7, atol=0.0)


def test_far_too_small_values_count_as_the_smallest_power() -> None:
    def power(values: Any, out: Any) -> None:
        a, _, _, d = exp2_x4(load(values, 0), load(values, 0), load(values, 0), load(values, 16))
        store(out, 0, a)
        store(out, 16, d)

    found = apply(power, np.repeat(np.float32([-1e30, -64.0]), WIDTH), 2)
    assert np.allclose(found, 2.0**-64, rtol=1e-6)
