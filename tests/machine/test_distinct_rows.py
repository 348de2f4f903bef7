"""Distinct rows, against numpy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engine.machine.distinct_rows import distinct_rows

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
