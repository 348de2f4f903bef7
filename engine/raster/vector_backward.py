"""Back-to-front gradients, sixteen pixels at a time. The same steps as ``blend_backward``, its readable twin,
where the equations stand.

One Gaussian after the other takes all its rows of the tile, so that its own sums stay in registers; the rows' state
lies in the first cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import Array, compiled, inlined, part
from .products import (
    BLOCK,
    ROWS,
    unblend_1,
    unblend_2,
    unblend_3,
    unblend_four_1,
    unblend_four_2,
    unblend_four_3,
)
from .records import (
    BLUE,
    CHUNK,
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
)
from .vector_chunk import AHEAD, LAST_LANE, NOBODY, origin_of, padded_channels
from .vector_forward import ALPHA_CAP, ALPHA_LEAST, LINES_AT_ONCE, ONE, ZERO, F, copy_labels
from .vectors import (
    bits_of,
    choose,
    everywhere,
    exp2_of_four,
    fetch,
    fma,
    get,
    lane_numbers,
    less_product,
    load,
    load_some,
    lowest_bit,
    maximum,
    minimum,
    planes_of,
    put,
    reciprocal,
    spread,
    store,
    store_past_cache,
    take_next,
    totals,
)

# a worker's scratch, in floats
S1_LEFT, S2, S2_SQUARED, EXPONENTS = 0, 2 * TILE, 4 * TILE, 6 * TILE  # of each row, for the Gaussian at hand
LAST_OF_ROW = 8 * TILE
RAW_ALPHAS = 9 * TILE  # [row or no row, pixel], before the cap, 0 where the Gaussian was not blended
OVERS = RAW_ALPHAS + (TILE + 1) * TILE  # 1 / (1 - alpha) of each
ROW_STATE = OVERS + (TILE + 1) * TILE  # [row or no row, field, pixel]; a row's fields lie together
ROW_STRIDE = 8 * TILE
THROUGH = ROW_STATE
LAST = THROUGH + TILE
BEHIND = LAST + TILE
D_PLANES = BEHIND + TILE  # gradients of red, green, blue, depth
WEIGHTS = ROW_STATE + (TILE + 1) * ROW_STRIDE  # [row, member, pixel]
CHUNK_LABELS = (
    WEIGHTS + TILE * CHUNK * TILE
)  # [member or nobody, padded], then a row's gradients [pixel, padded]
NO_ROW = TILE
"""Takes a row's place where there are not four; nothing was ever blended on it."""


def scratch_size(channels: int) -> int:
    """Floats of scratch that a worker needs."""
    floats: int = CHUNK_LABELS + (CHUNK + 1 + TILE) * padded_channels(channels)
    return floats


@part
def start_worker(scratch: Array, counts: Array) -> None:
    """Make NO_ROW, and lists of no members."""
    for at in range(ROW_STATE):
        put(scratch, at, ZERO)
    for at in range(ROW_STATE + NO_ROW * ROW_STRIDE, ROW_STATE + (NO_ROW + 1) * ROW_STRIDE):
        put(scratch, at, ZERO)
    store(scratch, LAST + NO_ROW * ROW_STRIDE, spread(-ONE))
    store(scratch, THROUGH + NO_ROW * ROW_STRIDE, spread(ONE))
    for r in range(TILE):
        put(counts, r, 0)


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
    inside = lane_numbers() < spread(F(width - left))
    far = -1
    for r in range(TILE):
        row = r * ROW_STRIDE
        own = -1
        if top + r >= height:
            store(scratch, LAST + row, spread(-ONE))
        else:
            pixel = (top + r) * width + left
            through = choose(inside, load_some(rest, pixel, inside), spread(ONE))
            store(scratch, THROUGH + row, through)
            store(scratch, BEHIND + row, spread(ZERO) - load_some(d_alpha, pixel, inside))
            store(scratch, LAST + row, choose(inside, load_some(last_in, pixel, inside), spread(-ONE)))
            store(scratch, D_PLANES + 3 * TILE + row, load_some(d_depth, pixel, inside))
            load_colours(3 * pixel, 3 * min(TILE, width - left), row, d_image, scratch)
            for x in range(min(TILE, width - left)):
                own = max(own, int(get(scratch, LAST + row + x)))
        scratch[LAST_OF_ROW + r] = F(own)
        far = max(far, own)
    return far


@part
def load_colours(source: int, floats: int, row: int, d_image: Array, scratch: Array) -> None:
    """d_image[source : source + floats], pixel after pixel, to a row's planes."""
    red, green, blue = planes_of(
        load_some(d_image, source, lane_numbers() < spread(F(floats))),
        load_some(d_image, source + TILE, lane_numbers() < spread(F(floats - TILE))),
        load_some(d_image, source + 2 * TILE, lane_numbers() < spread(F(floats - 2 * TILE))),
    )
    store(scratch, D_PLANES + row, red)
    store(scratch, D_PLANES + TILE + row, green)
    store(scratch, D_PLANES + 2 * TILE + row, blue)


@part
def whiten_tile(records: Array, at: int, left: int, top: int, scratch: Array) -> Any:
    """Fill S1_LEFT, S2, S2_SQUARED and EXPONENTS, bit for bit what the forward pass made of each row; returns the
    mask of the rows that are touched."""
    origin_s1, origin_s2 = origin_of(records, at, left, top)
    s1 = fma(everywhere(records, at + L12), lane_numbers(), spread(origin_s1))
    s2 = fma(everywhere(records, at + L22), lane_numbers(), spread(origin_s2))
    log_opacity = everywhere(records, at + LOG_OPACITY)
    right = fma(everywhere(records, at + L11), spread(LAST_LANE), s1)
    nearest = maximum(maximum(s1, spread(ZERO) - right), spread(ZERO))
    square = s2 * s2
    store(scratch, S1_LEFT, s1)
    store(scratch, S2, s2)
    store(scratch, S2_SQUARED, square)
    store(scratch, EXPONENTS, log_opacity - square)
    return bits_of(fma(nearest, nearest, square) <= log_opacity + spread(REACH_OVER_LOG_OPACITY))


@inlined
def whitened(r: int, slope: Any, scratch: Array) -> Any:
    """s1 on a row."""
    return fma(slope, lane_numbers(), everywhere(scratch, S1_LEFT + r))


@inlined
def exponent_of(r: int, slope: Any, scratch: Array) -> Any:
    """log2 of the Gaussian's alpha on a row."""
    s1 = whitened(r, slope, scratch)
    return less_product(s1, s1, everywhere(scratch, EXPONENTS + r))


@inlined
def blended_alpha(r: int, raw: Any, here: Any, scratch: Array) -> Any:
    """The alpha before the cap where the forward pass blended it, else 0."""
    blended = (raw >= spread(ALPHA_LEAST)) & (load(scratch, LAST + r * ROW_STRIDE) >= here)
    return choose(blended, raw, spread(ZERO))


@inlined
def keep_alpha(r: int, raw: Any, scratch: Array) -> None:
    store(scratch, RAW_ALPHAS + r * TILE, raw)
    store(scratch, OVERS + r * TILE, reciprocal(spread(ONE) - minimum(raw, spread(ALPHA_CAP))))


@part
def fill_alphas(slope: float, place: float, rows: int, scratch: Array) -> None:
    """RAW_ALPHAS and OVERS on the rows of a mask, bit for bit the forward pass's; four rows at a time, so that one
    does not wait for the other."""
    slopes, here = spread(slope), spread(place)
    while rows != 0:
        r0 = lowest_bit(rows)
        rows &= rows - 1
        r1 = min(lowest_bit(rows), NO_ROW)
        rows &= rows - 1
        r2 = min(lowest_bit(rows), NO_ROW)
        rows &= rows - 1
        r3 = min(lowest_bit(rows), NO_ROW)
        rows &= rows - 1
        e0, e1 = exponent_of(r0, slopes, scratch), exponent_of(r1, slopes, scratch)
        e2, e3 = exponent_of(r2, slopes, scratch), exponent_of(r3, slopes, scratch)
        raw0, raw1, raw2, raw3 = exp2_of_four(e0, e1, e2, e3)
        raw0, raw1 = blended_alpha(r0, raw0, here, scratch), blended_alpha(r1, raw1, here, scratch)
        raw2, raw3 = blended_alpha(r2, raw2, here, scratch), blended_alpha(r3, raw3, here, scratch)
        keep_alpha(r0, raw0, scratch)
        keep_alpha(r1, raw1, scratch)
        keep_alpha(r2, raw2, scratch)
        keep_alpha(r3, raw3, scratch)


@part
def unblend_gaussian(
    records: Array,
    at: int,
    member: int,
    rows: int,
    labelled: bool,
    scratch: Array,
    counts: Array,
    members: Array,
    gradients: Array,
    slot: int,
) -> None:
    """Step back over one Gaussian on the rows of a mask, and write its gradients."""
    slope = everywhere(records, at + L11)
    red, green = everywhere(records, at + RED), everywhere(records, at + GREEN)
    blue, depth = everywhere(records, at + BLUE), everywhere(records, at + DEPTH)
    g0 = g1 = g11 = g2 = g12 = g22 = spread(ZERO)
    d_red = d_green = d_blue = d_depth = spread(ZERO)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        row = r * ROW_STRIDE
        raw = load(scratch, RAW_ALPHAS + r * TILE)
        alpha = minimum(raw, spread(ALPHA_CAP))
        before = load(scratch, THROUGH + row) * load(scratch, OVERS + r * TILE)
        store(scratch, THROUGH + row, before)
        weight = alpha * before
        image_red = load(scratch, D_PLANES + row)
        image_green = load(scratch, D_PLANES + TILE + row)
        image_blue = load(scratch, D_PLANES + 2 * TILE + row)
        image_depth = load(scratch, D_PLANES + 3 * TILE + row)
        value = fma(red, image_red, fma(green, image_green, fma(blue, image_blue, depth * image_depth)))
        behind = load(scratch, BEHIND + row)
        difference = value - behind
        store(scratch, BEHIND + row, fma(alpha, difference, behind))
        g = choose(raw <= spread(ALPHA_CAP), weight * difference, spread(ZERO))
        s1, s2 = whitened(r, slope, scratch), everywhere(scratch, S2 + r)
        g_s1 = g * s1
        g0 = g0 + g
        g1 = g1 + g_s1
        g11 = fma(g_s1, s1, g11)
        g2 = fma(g, s2, g2)
        g12 = fma(g_s1, s2, g12)
        g22 = fma(g, everywhere(scratch, S2_SQUARED + r), g22)
        d_red = fma(weight, image_red, d_red)
        d_green = fma(weight, image_green, d_green)
        d_blue = fma(weight, image_blue, d_blue)
        d_depth = fma(weight, image_depth, d_depth)
        if labelled:
            # where nothing was blended the next one writes over it: cheaper than a branch that nobody can foresee
            count = get(counts, r)
            store(scratch, WEIGHTS + (r * CHUNK + count) * TILE, weight)
            put(members, r * CHUNK + count, np.int32(member))
            put(counts, r, count + int(bits_of(raw > spread(ZERO)) != 0))
    sums = (g0, g1, g11, g2, g12, g22, d_red, d_green, d_blue, d_depth)
    store_past_cache(gradients, slot * GRADIENT_WIDTH, totals(sums))


@part
def add_row_gradients(
    r: int, count: int, source: Array, at: int, stride: int, scratch: Array, members: Array, padded: int
) -> None:
    """The chunk's label gradients += the weights of row r, of so many members, times the label gradients of its
    pixels, which lie at source[at:], ``stride`` floats apart."""
    listed = r * CHUNK
    while count % 4 != 0:
        put(members, listed + count, np.int32(NOBODY))
        store(scratch, WEIGHTS + (listed + count) * TILE, spread(ZERO))
        count += 1
    k = 0
    while k + ROWS <= count:
        m, w = listed + k, WEIGHTS + (listed + k) * TILE
        c = 0
        while c + 3 * BLOCK <= padded:
            unblend_3(scratch, CHUNK_LABELS + c, members, m, source, at + c, scratch, w, padded, stride)
            c += 3 * BLOCK
        if c + 2 * BLOCK <= padded:
            unblend_2(scratch, CHUNK_LABELS + c, members, m, source, at + c, scratch, w, padded, stride)
        elif c + BLOCK <= padded:
            unblend_1(scratch, CHUNK_LABELS + c, members, m, source, at + c, scratch, w, padded, stride)
        k += ROWS
    if k < count:
        m, w = listed + k, WEIGHTS + (listed + k) * TILE
        c = 0
        while c + 3 * BLOCK <= padded:
            unblend_four_3(scratch, CHUNK_LABELS + c, members, m, source, at + c, scratch, w, padded, stride)
            c += 3 * BLOCK
        if c + 2 * BLOCK <= padded:
            unblend_four_2(scratch, CHUNK_LABELS + c, members, m, source, at + c, scratch, w, padded, stride)
        elif c + BLOCK <= padded:
            unblend_four_1(scratch, CHUNK_LABELS + c, members, m, source, at + c, scratch, w, padded, stride)


@part
def add_label_gradients(
    left: int,
    top: int,
    width: int,
    d_labels: Array,
    channels: int,
    scratch: Array,
    counts: Array,
    members: Array,
    padded: int,
) -> None:
    """The chunk's label gradients, row after row. They are read where they lie, beyond a pixel's own channels too (no
    one looks at what becomes of that); only where that would leave the row or the image are they copied first."""
    for r in range(TILE):
        count = get(counts, r)
        if count == 0:
            continue
        put(counts, r, 0)
        pixel = (top + r) * width + left
        if left + TILE <= width and (pixel + TILE) * channels + TILE <= d_labels.shape[0]:
            add_row_gradients(r, count, d_labels, pixel * channels, channels, scratch, members, padded)
        else:
            row = CHUNK_LABELS + (CHUNK + 1) * padded
            for x in range(TILE):
                if left + x < width:
                    copy_labels(pixel + x, d_labels, channels, scratch, row + x * padded)
                else:
                    for c in range(0, padded, TILE):
                        store(scratch, row + x * padded + c, spread(ZERO))
            add_row_gradients(r, count, scratch, row, padded, scratch, members, padded)


@compiled
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
    row_counts: Array,
) -> None:
    """Tile after tile until none is left: fill slot_gradients [T * 16] and slot_labels [T * padded channels]
    where touched uint8 [T] is set."""
    scratch, members, counts = scratches[worker], member_lists[worker], row_counts[worker]
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
        for chunk in range(far // CHUNK * CHUNK, -1, -CHUNK):
            for at in range(CHUNK_LABELS, CHUNK_LABELS + CHUNK * padded, TILE):
                store(scratch, at, spread(ZERO))
            for place in range(min(chunk + CHUNK - 1, far), chunk - 1, -1):
                at = int(get(tile_ids, first + place)) * RECORD
                fetch(records, int(get(tile_ids, first + max(place - AHEAD, 0))) * RECORD)
                slot = int(get(tile_slots, first + place))
                if ahead_row < ahead_rows:
                    ahead = ((top + ahead_row) * width + left) * channels + ahead_line * TILE
                    for line in range(LINES_AT_ONCE):
                        fetch(d_labels, ahead + line * TILE)
                    ahead_line += LINES_AT_ONCE
                    if ahead_line >= row_lines:
                        ahead_row, ahead_line = ahead_row + 1, 0
                rows = whiten_tile(records, at, left, top, scratch)
                rows &= bits_of(load(scratch, LAST_OF_ROW) >= spread(F(place)))
                if rows == 0:
                    touched[slot] = 0
                    continue
                touched[slot] = 1
                fill_alphas(get(records, at + L11), F(place), rows, scratch)
                unblend_gaussian(
                    records,
                    at,
                    place - chunk,
                    rows,
                    channels > 0,
                    scratch,
                    counts,
                    members,
                    slot_gradients,
                    slot,
                )
            if channels > 0:
                add_label_gradients(left, top, width, d_labels, channels, scratch, counts, members, padded)
                for place in range(chunk, min(chunk + CHUNK, far + 1)):
                    slot = int(tile_slots[first + place])
                    if touched[slot] != 0:
                        source = CHUNK_LABELS + (place - chunk) * padded
                        for c in range(0, padded, TILE):
                            store_past_cache(slot_labels, slot * padded + c, load(scratch, source + c))
