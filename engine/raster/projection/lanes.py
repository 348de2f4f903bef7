"""Sixteen Gaussians side by side, as projection and its chain rule take them.

All in double: it is cheap beside the blending, and thin Gaussians need it. A block has a row for every number of a
Gaussian, and in it a place for every lane. A loop over lanes without a branch is one that LLVM makes vectors of.
"""

from __future__ import annotations

from typing import Any

from ...machine.compiled import Array, device_function

LANES = 16
"""Gaussians of a block."""

# the rows that every block has, from which place on
MEAN, SCALE, QUAT = 0, 3 * LANES, 6 * LANES
WHO = 10 * LANES  # the Gaussian's number, which a double holds
OTHERS = 11 * LANES


@device_function
def load_lane(i: int, lane: int, gaussians: Any, block: Array) -> None:
    """Gaussian i of ``gaussians`` (with means, scales and quats) takes a lane."""
    for c in range(3):
        block[MEAN + c * LANES + lane] = gaussians.means[i, c]
        block[SCALE + c * LANES + lane] = gaussians.scales[i, c]
    for c in range(4):
        block[QUAT + c * LANES + lane] = gaussians.quats[i, c]
    block[WHO + lane] = i


@device_function
def three_of(rows: int, lane: int, block: Array) -> Any:
    """What a lane holds in three rows."""
    return block[rows + lane], block[rows + LANES + lane], block[rows + 2 * LANES + lane]


@device_function
def quaternion_in(lane: int, block: Array) -> Any:
    """A lane's, as it was given."""
    x, y, z = three_of(QUAT + LANES, lane, block)
    return block[QUAT + lane], x, y, z
