"""A tile in the backward pass, as patches: where a worker keeps it, and how it is read from the image."""

from __future__ import annotations

from typing import Any, NamedTuple

from ...machine.compiled import Array, device_function, inlined
from ...machine.vector_shuffles import deinterleave3, horizontal_max, interleave2
from ...machine.vectors import (
    broadcast,
    broadcast_load,
    fma,
    lane_numbers,
    load,
    masked_load,
    put,
    select,
    store,
)
from ..arrays import PixelGradients, Size, Tile
from ..records import (
    BACKWARD_BATCH,
    L11,
    L12,
    L22,
    LOG_OPACITY,
    MEMBERS,
    REACH_OVER_LOG_OPACITY,
    TILE,
    padded_channels,
)
from .batch import PATCHES, halves_touched, origin_of
from .forward_strip import ONE, ZERO, F

# a worker's scratch, in floats
S1_LEFT, S2, S2_SQUARED, EXPONENTS = 0, 2 * TILE, 4 * TILE, 6 * TILE  # of each row, for one Gaussian
WHITENED = 8 * TILE  # floats of the above: one set is for the current Gaussian, and one for the next
LAST_OF_PATCH = 2 * WHITENED
COLUMNS = LAST_OF_PATCH + TILE  # of a left patch's pixels, then of a right one's
RAW_ALPHAS = COLUMNS + 2 * TILE  # [patch or no patch, pixel], before the cap, 0 where the Gaussian was not blended
OVERS = RAW_ALPHAS + (PATCHES + 1) * TILE  # 1 / (1 - alpha) of each
PATCH_STATE = OVERS + (PATCHES + 1) * TILE  # [patch or no patch, field, pixel]; a patch's fields are adjacent
PATCH_STRIDE = 8 * TILE
TRANSMITTANCE = PATCH_STATE
LAST = TRANSMITTANCE + TILE
BEHIND = LAST + TILE
D_PLANES = BEHIND + TILE  # gradients of red, green, blue, depth
WEIGHTS = PATCH_STATE + (PATCHES + 1) * PATCH_STRIDE  # [patch, member, pixel]
LISTED = BACKWARD_BATCH + 4  # of a patch: its members, and those that fill up the last four
# [member or PAD_INDEX, padded], then a patch's gradients [pixel, padded]
BATCH_LABELS = WEIGHTS + PATCHES * LISTED * TILE
assert PATCHES * LISTED <= MEMBERS
NO_PATCH = PATCHES
"""The patch that fills up a group of four. Nothing is ever blended on it."""
EVEN = 0x5555
"""The even bits of a word of patches: those of the left patches of strips, whose numbers are also those of their first
rows."""


class PatchLists(NamedTuple):
    """The Gaussians of a batch that were blended on each patch: ``counts`` int64 [PATCHES] is their number, ``members``
    int32 [PATCHES * LISTED] lists them; their weights are in the scratch. Without labels (not ``wanted``) nothing is
    listed."""

    counts: Array
    members: Array
    wanted: bool


def scratch_size(channels: int) -> int:
    """The number of floats of scratch that a worker needs."""
    floats: int = BATCH_LABELS + (BACKWARD_BATCH + 1 + TILE) * padded_channels(channels)
    return floats


@device_function
def start_worker(scratch: Array, counts: Array) -> None:
    """Initialise NO_PATCH, and lists without members."""
    for at in range(PATCH_STATE):
        put(scratch, at, ZERO)
    left, right = interleave2(lane_numbers(), lane_numbers())
    store(scratch, COLUMNS, left)
    store(scratch, COLUMNS + TILE, right)
    for at in range(PATCH_STATE + NO_PATCH * PATCH_STRIDE, PATCH_STATE + (NO_PATCH + 1) * PATCH_STRIDE):
        put(scratch, at, ZERO)
    store(scratch, LAST + NO_PATCH * PATCH_STRIDE, broadcast(-ONE))
    store(scratch, TRANSMITTANCE + NO_PATCH * PATCH_STRIDE, broadcast(ONE))
    for patch in range(PATCHES):
        put(counts, patch, 0)


@inlined
def store_strip(upper: Any, lower: Any, at: int, scratch: Array) -> None:
    """Store two rows of a tile as a field of their two patches."""
    left, right = interleave2(upper, lower)
    store(scratch, at, left)
    store(scratch, at + PATCH_STRIDE, right)


@device_function
def load_tile(tile: Tile, size: Size, pixels: PixelGradients, scratch: Array) -> Any:
    """Load the tile's state at its far end; zeros outside the image. Returns the largest place blended in the tile."""
    left, top, width, height = tile.left, tile.top, size.width, size.height
    far = -1
    columns = min(TILE, width - left)
    for patch in range(0, PATCHES, 2):
        row = top + patch
        at = patch * PATCH_STRIDE
        pixel, below = row * width + left, (row + 1) * width + left
        # outside there are no columns
        upper_columns, lower_columns = columns if row < height else 0, columns if row + 1 < height else 0
        upper, lower = lane_numbers() < broadcast(F(upper_columns)), lane_numbers() < broadcast(F(lower_columns))
        store_strip(
            select(upper, masked_load(pixels.final, pixel, upper), broadcast(ONE)),
            select(lower, masked_load(pixels.final, below, lower), broadcast(ONE)),
            TRANSMITTANCE + at,
            scratch,
        )
        store_strip(
            broadcast(ZERO) - masked_load(pixels.alpha, pixel, upper),
            broadcast(ZERO) - masked_load(pixels.alpha, below, lower),
            BEHIND + at,
            scratch,
        )
        store_strip(
            select(upper, masked_load(pixels.last, pixel, upper), broadcast(-ONE)),
            select(lower, masked_load(pixels.last, below, lower), broadcast(-ONE)),
            LAST + at,
            scratch,
        )
        upper_red, upper_green, upper_blue = colours_of(3 * pixel, 3 * upper_columns, pixels.image)
        lower_red, lower_green, lower_blue = colours_of(3 * below, 3 * lower_columns, pixels.image)
        store_strip(upper_red, lower_red, D_PLANES + at, scratch)
        store_strip(upper_green, lower_green, D_PLANES + TILE + at, scratch)
        store_strip(upper_blue, lower_blue, D_PLANES + 2 * TILE + at, scratch)
        store_strip(
            masked_load(pixels.depth, pixel, upper),
            masked_load(pixels.depth, below, lower),
            D_PLANES + 3 * TILE + at,
            scratch,
        )
        for each in (patch, patch + 1):
            own = horizontal_max(load(scratch, LAST + each * PATCH_STRIDE))
            put(scratch, LAST_OF_PATCH + each, own)
            far = max(far, int(own))
    return far


@inlined
def colours_of(source: int, floats: int, d_image: Array) -> Any:
    """d_image[source : source + floats], which is stored pixel by pixel, as planes."""
    return deinterleave3(
        masked_load(d_image, source, lane_numbers() < broadcast(F(floats))),
        masked_load(d_image, source + TILE, lane_numbers() < broadcast(F(floats - TILE))),
        masked_load(d_image, source + 2 * TILE, lane_numbers() < broadcast(F(floats - 2 * TILE))),
    )


@device_function
def whiten_tile(records: Array, at: int, tile: Tile, scratch: Array, own: int) -> Any:
    """Fill S1_LEFT, S2, S2_SQUARED and EXPONENTS of scratch[own:], with the same bits as each row in the forward pass.
    Returns the mask of the patches that are touched."""
    origin_s1, origin_s2 = origin_of(records, at, tile)
    s1 = fma(broadcast_load(records, at + L12), lane_numbers(), broadcast(origin_s1))
    s2 = fma(broadcast_load(records, at + L22), lane_numbers(), broadcast(origin_s2))
    log_opacity = broadcast_load(records, at + LOG_OPACITY)
    square = s2 * s2
    store(scratch, own + S1_LEFT, s1)
    store(scratch, own + S2, s2)
    store(scratch, own + S2_SQUARED, square)
    store(scratch, own + EXPONENTS, log_opacity - square)
    reach = log_opacity + broadcast(REACH_OVER_LOG_OPACITY)
    on_left, on_right = halves_touched(s1, broadcast_load(records, at + L11), square, reach)
    return strips_of(on_left) | (strips_of(on_right) << 1)


@inlined
def strips_of(mask: int) -> int:
    """The even bits of a mask of rows, set for strips that have a row in the mask."""
    return (mask | (mask >> 1)) & EVEN
