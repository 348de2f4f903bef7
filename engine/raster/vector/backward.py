"""Back-to-front gradients, a patch of sixteen pixels at a time. The same steps as ``blend_backward``, its readable
twin, where the equations stand.

One Gaussian after the other takes all its patches of the tile, so that its own sums stay in registers; the patches'
state lies in the first cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.atomics import take_next
from ...machine.compiled import Array, inlined, parallel_kernel, part
from ...machine.vector_functions import exp2_of_four, reciprocal
from ...machine.vector_shuffles import totals
from ...machine.vectors import (
    bits_of,
    choose,
    everywhere,
    fetch,
    fma,
    get,
    lane_numbers,
    less_product,
    load,
    lowest_bit,
    minimum,
    pairs,
    put,
    spread,
    store,
    store_past_cache,
)
from ..records import (
    BATCH,
    BLUE,
    DEPTH,
    GRADIENT_WIDTH,
    GREEN,
    L11,
    L12,
    L22,
    LOG_OPACITY,
    REACH_OVER_LOG_OPACITY,
    RECORD,
    RED,
    TILE,
    padded_channels,
)
from .backward_tile import (
    BATCH_LABELS,
    BEHIND,
    COLUMNS,
    D_PLANES,
    EXPONENTS,
    LAST,
    LAST_OF_PATCH,
    LISTED,
    NO_PATCH,
    OVERS,
    PATCH_STRIDE,
    RAW_ALPHAS,
    S1_LEFT,
    S2,
    S2_SQUARED,
    THROUGH,
    WEIGHTS,
    WHITENED,
    load_tile,
    start_worker,
)
from .chunk import AHEAD, halves_touched, origin_of
from .forward import ALPHA_CAP, ALPHA_LEAST, take_four
from .forward_strip import ONE, ZERO, F
from .label_gradients import add_label_gradients, write_label_gradients
from .labels import LINES_AT_ONCE

EVEN = 0x5555
"""The even bits of a word of patches: those on the left of their strips, whose numbers are also those of their first
rows."""


@part
def whiten_tile(records: Array, at: int, left: int, top: int, scratch: Array, own: int) -> Any:
    """Fill S1_LEFT, S2, S2_SQUARED and EXPONENTS of scratch[own:], bit for bit what the forward pass made of each row;
    returns the mask of the patches that are touched."""
    origin_s1, origin_s2 = origin_of(records, at, left, top)
    s1 = fma(everywhere(records, at + L12), lane_numbers(), spread(origin_s1))
    s2 = fma(everywhere(records, at + L22), lane_numbers(), spread(origin_s2))
    log_opacity = everywhere(records, at + LOG_OPACITY)
    square = s2 * s2
    store(scratch, own + S1_LEFT, s1)
    store(scratch, own + S2, s2)
    store(scratch, own + S2_SQUARED, square)
    store(scratch, own + EXPONENTS, log_opacity - square)
    reach = log_opacity + spread(REACH_OVER_LOG_OPACITY)
    on_left, on_right = halves_touched(s1, everywhere(records, at + L11), square, reach)
    return strips_of(on_left) | (strips_of(on_right) << 1)


@inlined
def strips_of(mask: int) -> int:
    """The even bits of a mask of rows, set where a strip has a row of it."""
    return (mask | (mask >> 1)) & EVEN


@inlined
def whitened(patch: int, slope: Any, scratch: Array, own: int) -> Any:
    """s1 on a patch."""
    row, side = patch & -2, patch & 1
    return fma(slope, load(scratch, COLUMNS + side * TILE), pairs(scratch, own + S1_LEFT + row))


@inlined
def exponent_of(patch: int, slope: Any, scratch: Array, own: int) -> Any:
    """log2 of the Gaussian's alpha on a patch."""
    s1 = whitened(patch, slope, scratch, own)
    return less_product(s1, s1, pairs(scratch, own + EXPONENTS + (patch & -2)))


@inlined
def blended_alpha(patch: int, raw: Any, here: Any, scratch: Array) -> Any:
    """The alpha before the cap where the forward pass blended it, else 0."""
    blended = (raw >= spread(ALPHA_LEAST)) & (load(scratch, LAST + patch * PATCH_STRIDE) >= here)
    return choose(blended, raw, spread(ZERO))


@inlined
def keep_alpha(patch: int, raw: Any, scratch: Array) -> None:
    store(scratch, RAW_ALPHAS + patch * TILE, raw)
    store(scratch, OVERS + patch * TILE, reciprocal(spread(ONE) - minimum(raw, spread(ALPHA_CAP))))


@part
def fill_alphas(slope: float, place: float, patches: int, scratch: Array, own: int) -> None:
    """RAW_ALPHAS and OVERS on the patches of a mask, bit for bit the forward pass's; four at a time, so that one does
    not wait for the other."""
    slopes, here = spread(slope), spread(place)
    while patches != 0:
        (p0, p1, p2, p3), patches = take_four(patches, NO_PATCH)
        e0, e1 = exponent_of(p0, slopes, scratch, own), exponent_of(p1, slopes, scratch, own)
        e2, e3 = exponent_of(p2, slopes, scratch, own), exponent_of(p3, slopes, scratch, own)
        raw0, raw1, raw2, raw3 = exp2_of_four(e0, e1, e2, e3)
        raw0, raw1 = blended_alpha(p0, raw0, here, scratch), blended_alpha(p1, raw1, here, scratch)
        raw2, raw3 = blended_alpha(p2, raw2, here, scratch), blended_alpha(p3, raw3, here, scratch)
        keep_alpha(p0, raw0, scratch)
        keep_alpha(p1, raw1, scratch)
        keep_alpha(p2, raw2, scratch)
        keep_alpha(p3, raw3, scratch)


@part
def unblend_gaussian(
    records: Array,
    at: int,
    member: int,
    patches: int,
    labelled: bool,
    scratch: Array,
    own: int,
    counts: Array,
    members: Array,
    gradients: Array,
    slot: int,
) -> None:
    """Step back over one Gaussian on the patches of a mask, and write its gradients."""
    slope = everywhere(records, at + L11)
    red, green = everywhere(records, at + RED), everywhere(records, at + GREEN)
    blue, depth = everywhere(records, at + BLUE), everywhere(records, at + DEPTH)
    g0 = g1 = g11 = g2 = g12 = g22 = spread(ZERO)
    d_red = d_green = d_blue = d_depth = spread(ZERO)
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        state, row = patch * PATCH_STRIDE, patch & -2
        raw = load(scratch, RAW_ALPHAS + patch * TILE)
        alpha = minimum(raw, spread(ALPHA_CAP))
        before = load(scratch, THROUGH + state) * load(scratch, OVERS + patch * TILE)
        store(scratch, THROUGH + state, before)
        weight = alpha * before
        image_red = load(scratch, D_PLANES + state)
        image_green = load(scratch, D_PLANES + TILE + state)
        image_blue = load(scratch, D_PLANES + 2 * TILE + state)
        image_depth = load(scratch, D_PLANES + 3 * TILE + state)
        value = fma(red, image_red, fma(green, image_green, fma(blue, image_blue, depth * image_depth)))
        behind = load(scratch, BEHIND + state)
        difference = value - behind
        store(scratch, BEHIND + state, fma(alpha, difference, behind))
        g = choose(raw <= spread(ALPHA_CAP), weight * difference, spread(ZERO))
        s1, s2 = whitened(patch, slope, scratch, own), pairs(scratch, own + S2 + row)
        g_s1 = g * s1
        g0 = g0 + g
        g1 = g1 + g_s1
        g11 = fma(g_s1, s1, g11)
        g2 = fma(g, s2, g2)
        g12 = fma(g_s1, s2, g12)
        g22 = fma(g, pairs(scratch, own + S2_SQUARED + row), g22)
        d_red = fma(weight, image_red, d_red)
        d_green = fma(weight, image_green, d_green)
        d_blue = fma(weight, image_blue, d_blue)
        d_depth = fma(weight, image_depth, d_depth)
        if labelled:
            # where nothing was blended the next one writes over it: cheaper than a branch that nobody can foresee
            count = get(counts, patch)
            store(scratch, WEIGHTS + (patch * LISTED + count) * TILE, weight)
            put(members, patch * LISTED + count, np.int32(member))
            put(counts, patch, count + int(bits_of(raw > spread(ZERO)) != 0))
    sums = (g0, g1, g11, g2, g12, g22, d_red, d_green, d_blue, d_depth)
    store_past_cache(gradients, slot * GRADIENT_WIDTH, totals(sums))


@parallel_kernel
def unblend_tiles(
    worker: int,
    workers: int,
    next_tile: Array,
    starts: Array,
    tile_ids: Array,
    tile_slots: Array,
    records: Array,
    rest: Array,
    last_in: Array,
    d_image: Array,
    d_labels: Array,
    channels: int,
    d_alpha: Array,
    d_depth: Array,
    width: int,
    height: int,
    touched: Array,
    slot_gradients: Array,
    slot_labels: Array,
    scratches: Array,
    member_lists: Array,
    patch_counts: Array,
) -> None:
    """Tile after tile until none is left: fill slot_gradients [T * 16] and slot_labels [T * padded channels]
    where touched uint8 [T] is set."""
    scratch, members, counts = scratches[worker], member_lists[worker], patch_counts[worker]
    columns = (width + TILE - 1) // TILE
    tiles = starts.shape[0] - 1
    padded = padded_channels(channels)
    start_worker(scratch, counts)
    while True:
        tile = take_next(next_tile)
        if tile >= tiles:
            break
        left = tile % columns * TILE
        top = tile // columns * TILE
        first = starts[tile]
        far = load_tile(left, top, width, height, rest, last_in, d_image, d_alpha, d_depth, scratch)
        for k in range(first + far + 1, starts[tile + 1]):
            touched[tile_slots[k]] = 0
        if far < 0:
            continue
        # the tile's label gradients are asked for while the first Gaussians are on
        row_lines = (min(TILE, width - left) * channels + TILE - 1) // TILE
        ahead_rows, ahead_row, ahead_line = min(TILE, height - top) if channels > 0 else 0, 0, 0
        # each Gaussian is whitened while the one before is on: which patches it touches is known when its turn comes
        own = 0
        patches = whiten_tile(records, int(get(tile_ids, first + far)) * RECORD, left, top, scratch, own)
        for batch in range(far // BATCH * BATCH, -1, -BATCH):
            for at in range(BATCH_LABELS, BATCH_LABELS + BATCH * padded, TILE):
                store(scratch, at, spread(ZERO))
            for place in range(min(batch + BATCH - 1, far), batch - 1, -1):
                touching = patches & bits_of(load(scratch, LAST_OF_PATCH) >= spread(F(place)))
                at = int(get(tile_ids, first + place)) * RECORD
                following = int(get(tile_ids, first + max(place - 1, 0))) * RECORD
                fetch(records, int(get(tile_ids, first + max(place - AHEAD, 0))) * RECORD)
                patches = whiten_tile(records, following, left, top, scratch, WHITENED - own)
                slot = int(get(tile_slots, first + place))
                if ahead_row < ahead_rows:
                    ahead = ((top + ahead_row) * width + left) * channels + ahead_line * TILE
                    for line in range(LINES_AT_ONCE):
                        fetch(d_labels, ahead + line * TILE)
                    ahead_line += LINES_AT_ONCE
                    if ahead_line >= row_lines:
                        ahead_row, ahead_line = ahead_row + 1, 0
                touched[slot] = touching != 0
                if touching != 0:
                    fill_alphas(get(records, at + L11), F(place), touching, scratch, own)
                    unblend_gaussian(
                        records,
                        at,
                        place - batch,
                        touching,
                        channels > 0,
                        scratch,
                        own,
                        counts,
                        members,
                        slot_gradients,
                        slot,
                    )
                own = WHITENED - own
            if channels > 0:
                add_label_gradients(left, top, width, height, d_labels, channels, scratch, counts, members, padded)
                count = min(BATCH, far + 1 - batch)
                write_label_gradients(batch, count, first, tile_slots, touched, scratch, slot_labels, padded)
