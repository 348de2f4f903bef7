"""A Gaussian on a tile: which rows it touches, and its alpha along a row of sixteen pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, contracted_device_function, device_function
from ..conventions import ALPHA_MAX
from ..records import (
    CENTRE_X,
    CENTRE_X_LOW,
    CENTRE_Y,
    CENTRE_Y_LOW,
    L11,
    L11_LOW,
    L12,
    L12_LOW,
    L22,
    L22_LOW,
    LOG_OPACITY,
    REACH_OVER_LOG_OPACITY,
    TILE,
)

F = np.float32
LANES = np.arange(TILE, dtype=np.float32)
LAST_LANE = F(TILE - 1)
ZERO = F(0.0)
ALPHA_CAP = F(ALPHA_MAX)
LOWEST_EXPONENT = F(-64.0)  # far from the subnormals, which are slow
ROUNDING = F(12582912.0)  # adding and subtracting it rounds to the nearest integer
# 2^f on [-1/2, 1/2], Chebyshev interpolation, relative error 1e-7 in float32
E0, E1, E2, E3 = F(1.0), F(0.6931471824645996), F(0.24022650718688965), F(0.05550327152013779)
E4, E5, E6 = F(0.009618056938052177), F(0.0013400427997112274), F(0.00015461444854736328)


@device_function
def whiten_rows(record: Array, left: int, top: int, s1_left: Array, s2: Array) -> Any:
    """s1 at the first pixel and s2 of each of the tile's rows; returns the mask of the rows that the
    footprint touches."""
    # the origin in double, once a tile: everything after is within a few standard deviations
    dx = (left + 0.5 - np.float64(record[CENTRE_X])) - np.float64(record[CENTRE_X_LOW])
    dy = (top + 0.5 - np.float64(record[CENTRE_Y])) - np.float64(record[CENTRE_Y_LOW])
    l11 = np.float64(record[L11]) + np.float64(record[L11_LOW])
    l12 = np.float64(record[L12]) + np.float64(record[L12_LOW])
    s1_origin = F(l11 * dx + l12 * dy)
    s2_origin = F((np.float64(record[L22]) + np.float64(record[L22_LOW])) * dy)
    across = record[L11] * LAST_LANE
    reach = record[LOG_OPACITY] + REACH_OVER_LOG_OPACITY
    rows = 0
    for r in range(TILE):
        s1_left[r] = s1_origin + record[L12] * F(r)
        s2[r] = s2_origin + record[L22] * F(r)
        nearest = max(max(s1_left[r], -(s1_left[r] + across)), ZERO)
        if nearest * nearest + s2[r] * s2[r] <= reach:
            rows |= 1 << r
    return rows


@device_function
def alpha_row(s1_left: float, slope: float, s2: float, opacity: float, s1: Array, raw: Array, bits: Array) -> None:
    """Fill s1 [16] and raw [16] = opacity * 2^-(s1^2 + s2^2), before the cap. bits int32 [16] is a view of
    raw."""
    for x in range(TILE):
        s1[x] = s1_left + slope * LANES[x]
    s2_squared = s2 * s2
    for x in range(TILE):
        exponent = max(-(s1[x] * s1[x] + s2_squared), LOWEST_EXPONENT)
        whole = (exponent + ROUNDING) - ROUNDING
        f = exponent - whole
        raw[x] = E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * (E5 + f * E6)))))
    for x in range(TILE):
        exponent = max(-(s1[x] * s1[x] + s2_squared), LOWEST_EXPONENT)
        whole = (exponent + ROUNDING) - ROUNDING
        bits[x] += np.int32(whole) << np.int32(23)
    for x in range(TILE):
        raw[x] = raw[x] * opacity


@contracted_device_function
def add_product(
    out: Array,
    out_rows: Array,
    weights: Array,
    count: tuple[int, int],
    source: Array,
    source_rows: Array,
    channels: int,
) -> None:
    """out[out_rows[a]] += sum_b weights[a, b] * source[source_rows[b]], over a < count[0] and b < count[1],
    multiples of four.

    The one matrix product of both passes, four rows by four: sixteen multiply-adds for every four loads and
    stores.
    """
    for a in range(0, count[0], 4):
        o0, o1, o2, o3 = out[out_rows[a]], out[out_rows[a + 1]], out[out_rows[a + 2]], out[out_rows[a + 3]]
        for b in range(0, count[1], 4):
            f0 = source[source_rows[b]]
            f1 = source[source_rows[b + 1]]
            f2 = source[source_rows[b + 2]]
            f3 = source[source_rows[b + 3]]
            w00, w01, w02, w03 = weights[a, b], weights[a, b + 1], weights[a, b + 2], weights[a, b + 3]
            w10, w11, w12, w13 = (
                weights[a + 1, b],
                weights[a + 1, b + 1],
                weights[a + 1, b + 2],
                weights[a + 1, b + 3],
            )
            w20, w21, w22, w23 = (
                weights[a + 2, b],
                weights[a + 2, b + 1],
                weights[a + 2, b + 2],
                weights[a + 2, b + 3],
            )
            w30, w31, w32, w33 = (
                weights[a + 3, b],
                weights[a + 3, b + 1],
                weights[a + 3, b + 2],
                weights[a + 3, b + 3],
            )
            for c in range(channels):
                g0, g1, g2, g3 = f0[c], f1[c], f2[c], f3[c]
                o0[c] += w00 * g0 + w01 * g1 + w02 * g2 + w03 * g3
                o1[c] += w10 * g0 + w11 * g1 + w12 * g2 + w13 * g3
                o2[c] += w20 * g0 + w21 * g1 + w22 * g2 + w23 * g3
                o3[c] += w30 * g0 + w31 * g1 + w32 * g2 + w33 * g3
