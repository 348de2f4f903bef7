"""A tile on the way back, as patches: where a worker keeps it, and how it comes out of the image."""

from __future__ import annotations

from typing import Any

from ...machine.compiled import Array, inlined, part
from ...machine.vector_shuffles import largest, planes_of, zipped
from ...machine.vectors import choose, lane_numbers, load, load_some, put, spread, store
from ..records import BATCH, MEMBERS, TILE, padded_channels
from .chunk import PATCHES
from .forward_strip import ONE, ZERO, F

# a worker's scratch, in floats
S1_LEFT, S2, S2_SQUARED, EXPONENTS = 0, 2 * TILE, 4 * TILE, 6 * TILE  # of each row, for one Gaussian
WHITENED = 8 * TILE  # floats of the above: there is one for the Gaussian at hand, and one for the next
LAST_OF_PATCH = 2 * WHITENED
COLUMNS = LAST_OF_PATCH + TILE  # of a left patch's pixels, of a right one's
RAW_ALPHAS = COLUMNS + 2 * TILE  # [patch or no patch, pixel], before the cap, 0 where the Gaussian was not blended
OVERS = RAW_ALPHAS + (PATCHES + 1) * TILE  # 1 / (1 - alpha) of each
PATCH_STATE = OVERS + (PATCHES + 1) * TILE  # [patch or no patch, field, pixel]; a patch's fields lie together
PATCH_STRIDE = 8 * TILE
THROUGH = PATCH_STATE
LAST = THROUGH + TILE
BEHIND = LAST + TILE
D_PLANES = BEHIND + TILE  # gradients of red, green, blue, depth
WEIGHTS = PATCH_STATE + (PATCHES + 1) * PATCH_STRIDE  # [patch, member, pixel]
LISTED = BATCH + 4  # of a patch: its members, and as many as are missing from the last four
BATCH_LABELS = (
    WEIGHTS + PATCHES * LISTED * TILE
)  # [member or nobody, padded], then a patch's gradients [row, pixel, padded]
assert PATCHES * LISTED <= MEMBERS
NO_PATCH = PATCHES
"""Takes a patch's place where there are not four; nothing was ever blended on it."""


def scratch_size(channels: int) -> int:
    """Floats of scratch that a worker needs."""
    floats: int = BATCH_LABELS + (BATCH + 1 + TILE) * padded_channels(channels)
    return floats


@part
def start_worker(scratch: Array, counts: Array) -> None:
    """Make NO_PATCH, and lists of no members."""
    for at in range(PATCH_STATE):
        put(scratch, at, ZERO)
    left, right = zipped(lane_numbers(), lane_numbers())
    store(scratch, COLUMNS, left)
    store(scratch, COLUMNS + TILE, right)
    for at in range(PATCH_STATE + NO_PATCH * PATCH_STRIDE, PATCH_STATE + (NO_PATCH + 1) * PATCH_STRIDE):
        put(scratch, at, ZERO)
    store(scratch, LAST + NO_PATCH * PATCH_STRIDE, spread(-ONE))
    store(scratch, THROUGH + NO_PATCH * PATCH_STRIDE, spread(ONE))
    for patch in range(PATCHES):
        put(counts, patch, 0)


@inlined
def store_strip(upper: Any, lower: Any, at: int, scratch: Array) -> None:
    """Two rows of a tile, as a field of the two patches that they are."""
    left, right = zipped(upper, lower)
    store(scratch, at, left)
    store(scratch, at + PATCH_STRIDE, right)


@part
def load_tile(
    left: int,
    top: int,
    width: int,
    height: int,
    rest: Array,
    last_in: Array,
    d_image: Array,
    d_alpha: Array,
    d_depth: Array,
    scratch: Array,
) -> Any:
    """The tile's state at its far end; zeros outside the image. Returns the largest place blended in the
    tile."""
    far = -1
    columns = min(TILE, width - left)
    for patch in range(0, PATCHES, 2):
        row = top + patch
        at = patch * PATCH_STRIDE
        pixel, below = row * width + left, (row + 1) * width + left
        # outside there are no columns
        upper_columns, lower_columns = columns if row < height else 0, columns if row + 1 < height else 0
        upper, lower = lane_numbers() < spread(F(upper_columns)), lane_numbers() < spread(F(lower_columns))
        store_strip(
            choose(upper, load_some(rest, pixel, upper), spread(ONE)),
            choose(lower, load_some(rest, below, lower), spread(ONE)),
            THROUGH + at,
            scratch,
        )
        store_strip(
            spread(ZERO) - load_some(d_alpha, pixel, upper),
            spread(ZERO) - load_some(d_alpha, below, lower),
            BEHIND + at,
            scratch,
        )
        store_strip(
            choose(upper, load_some(last_in, pixel, upper), spread(-ONE)),
            choose(lower, load_some(last_in, below, lower), spread(-ONE)),
            LAST + at,
            scratch,
        )
        upper_red, upper_green, upper_blue = colours_of(3 * pixel, 3 * upper_columns, d_image)
        lower_red, lower_green, lower_blue = colours_of(3 * below, 3 * lower_columns, d_image)
        store_strip(upper_red, lower_red, D_PLANES + at, scratch)
        store_strip(upper_green, lower_green, D_PLANES + TILE + at, scratch)
        store_strip(upper_blue, lower_blue, D_PLANES + 2 * TILE + at, scratch)
        store_strip(
            load_some(d_depth, pixel, upper), load_some(d_depth, below, lower), D_PLANES + 3 * TILE + at, scratch
        )
        for each in (patch, patch + 1):
            own = largest(load(scratch, LAST + each * PATCH_STRIDE))
            put(scratch, LAST_OF_PATCH + each, own)
            far = max(far, int(own))
    return far


@inlined
def colours_of(source: int, floats: int, d_image: Array) -> Any:
    """d_image[source : source + floats], pixel after pixel, as planes."""
    return planes_of(
        load_some(d_image, source, lane_numbers() < spread(F(floats))),
        load_some(d_image, source + TILE, lane_numbers() < spread(F(floats - TILE))),
        load_some(d_image, source + 2 * TILE, lane_numbers() < spread(F(floats - 2 * TILE))),
    )
