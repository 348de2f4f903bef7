"""Sixteen float32 at a time, and distinct rows: they do what NumPy does."""

from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engine.machine.distinct_rows import distinct_rows
from engine.machine.vectors import WIDTH, exp2, exp2_x4, load, store


def apply(function: Any, values: np.ndarray, results: int) -> np.ndarray:
    """The results that a function of a flat array writes to another one, vector by vector."""
    out = np.zeros(results * WIDTH, np.float32)
    numba.njit(function)(values, out)
    return out.reshape(results, WIDTH)


@pytest.mark.parametrize("span", [(-63.9, 126.9), (-8.0, 0.0), (-1e-3, 1e-3)])
def test_vectorised_powers_of_two_match_numpy(span: tuple[float, float]) -> None:
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


def test_vectorised_powers_of_very_small_exponents_are_clamped() -> None:
    def power(values: Any, out: Any) -> None:
        a, _, _, d = exp2_x4(load(values, 0), load(values, 0), load(values, 0), load(values, 16))
        store(out, 0, a)
        store(out, 16, d)

    found = apply(power, np.repeat(np.float32([-1e30, -64.0]), WIDTH), 2)
    assert np.allclose(found, 2.0**-64, rtol=1e-6)


SPREADS = st.sampled_from([1, 3, 10**6, 2**62])


@given(
    SPREADS.flatmap(
        lambda far: arrays(np.int64, st.tuples(st.integers(0, 30), st.just(3)), elements=st.integers(-far, far))
    )
)
def test_distinct_rows_match_numpy_unique(rows: np.ndarray) -> None:
    distinct, index = distinct_rows(rows)
    expected, inverse = np.unique(rows, axis=0, return_inverse=True)
    np.testing.assert_array_equal(distinct, expected)
    np.testing.assert_array_equal(index, inverse.reshape(-1))
