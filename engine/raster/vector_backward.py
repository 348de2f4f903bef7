"""Back-to-front gradients, a patch of sixteen pixels at a time. The same steps as ``blend_backward``, its readable
twin, where the equations stand.

One Gaussian after the other takes all its patches of the tile, so that its own sums stay in registers; the patches'
state lies in the first cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..machine.compiled import Array, compiled, inlined, part
from ..machine.vector_functions import exp2_of_four, reciprocal
from ..machine.vector_shuffles import largest, planes_of, totals, zipped
from ..machine.vectors import (
    bits_of,
    choose,
    everywhere,
    fetch,
    fma,
    get,
    lane_numbers,
    less_product,
    load,
    load_some,
    lowest_bit,
    minimum,
    pairs,
    put,
    spread,
    store,
    store_past_cache,
    take_next,
)
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
    PATCH_HEIGHT,
    PATCH_WIDTH,
    REACH_OVER_LOG_OPACITY,
    RECORD,
    RED,
    TILE,
)
from .vector_chunk import AHEAD, NOBODY, PATCHES, halves_touched, origin_of, padded_channels
from .vector_forward import ALPHA_CAP, ALPHA_LEAST, LINES_AT_ONCE, ONE, ZERO, F, copy_labels, take_four

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
CHUNK_LABELS = (
    WEIGHTS + PATCHES * CHUNK * TILE
)  # [member or nobody, padded], then a patch's gradients [row, pixel, padded]
EVEN = 0x5555
"""The even bits of a word of patches: those on the left of their strips, whose numbers are also those of their first
rows."""
NO_PATCH = PATCHES
"""Takes a patch's place where there are not four; nothing was ever blended on it."""


def scratch_size(channels: int) -> int:
    """Floats of scratch that a worker needs."""
    floats: int = CHUNK_LABELS + (CHUNK + 1 + TILE) * padded_channels(channels)
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
            store(scratch, WEIGHTS + (patch * CHUNK + count) * TILE, weight)
            put(members, patch * CHUNK + count, np.int32(member))
            put(counts, patch, count + int(bits_of(raw > spread(ZERO)) != 0))
    sums = (g0, g1, g11, g2, g12, g22, d_red, d_green, d_blue, d_depth)
    store_past_cache(gradients, slot * GRADIENT_WIDTH, totals(sums))


@part
def add_patch_gradients(
    patch: int,
    count: int,
    source: Array,
    upper: int,
    lower: int,
    stride: int,
    scratch: Array,
    members: Array,
    padded: int,
) -> None:
    """The chunk's label gradients += the weights of a patch, of so many members, times the label gradients of its
    pixels: those of its two rows lie at source[upper:] and source[lower:], ``stride`` floats apart."""
    listed = patch * CHUNK
    while count % 4 != 0:
        put(members, listed + count, np.int32(NOBODY))
        store(scratch, WEIGHTS + (listed + count) * TILE, spread(ZERO))
        count += 1
    k = 0
    while k + ROWS <= count:
        m, w = listed + k, WEIGHTS + (listed + k) * TILE
        out, c = CHUNK_LABELS, 0
        while c + 3 * BLOCK <= padded:
            unblend_3(scratch, out + c, members, m, source, upper + c, lower + c, scratch, w, padded, stride)
            c += 3 * BLOCK
        if c + 2 * BLOCK <= padded:
            unblend_2(scratch, out + c, members, m, source, upper + c, lower + c, scratch, w, padded, stride)
        elif c + BLOCK <= padded:
            unblend_1(scratch, out + c, members, m, source, upper + c, lower + c, scratch, w, padded, stride)
        k += ROWS
    if k < count:
        m, w = listed + k, WEIGHTS + (listed + k) * TILE
        out, c = CHUNK_LABELS, 0
        while c + 3 * BLOCK <= padded:
            unblend_four_3(scratch, out + c, members, m, source, upper + c, lower + c, scratch, w, padded, stride)
            c += 3 * BLOCK
        if c + 2 * BLOCK <= padded:
            unblend_four_2(scratch, out + c, members, m, source, upper + c, lower + c, scratch, w, padded, stride)
        elif c + BLOCK <= padded:
            unblend_four_1(scratch, out + c, members, m, source, upper + c, lower + c, scratch, w, padded, stride)


@part
def add_label_gradients(
    left: int,
    top: int,
    width: int,
    height: int,
    d_labels: Array,
    channels: int,
    scratch: Array,
    counts: Array,
    members: Array,
    padded: int,
) -> None:
    """The chunk's label gradients, patch after patch. They are read where they lie, beyond a pixel's own channels too
    (no one looks at what becomes of that); only where that would leave the row or the image are they copied first."""
    for patch in range(PATCHES):
        count = get(counts, patch)
        if count == 0:
            continue
        put(counts, patch, 0)
        row, column = top + (patch & -2), left + (patch & 1) * PATCH_WIDTH
        upper = row * width + column
        lower = upper + width
        is_inside = column + PATCH_WIDTH <= width and row + PATCH_HEIGHT <= height
        if is_inside and (lower + PATCH_WIDTH) * channels + TILE <= d_labels.shape[0]:
            upper, lower = upper * channels, lower * channels
            add_patch_gradients(patch, count, d_labels, upper, lower, channels, scratch, members, padded)
        else:
            copy = CHUNK_LABELS + (CHUNK + 1) * padded
            for y in range(PATCH_HEIGHT):
                for x in range(PATCH_WIDTH):
                    at = copy + (y * PATCH_WIDTH + x) * padded
                    if row + y < height and column + x < width:
                        copy_labels((row + y) * width + column + x, d_labels, channels, scratch, at)
                    else:
                        for c in range(0, padded, TILE):
                            store(scratch, at + c, spread(ZERO))
            lower = copy + PATCH_WIDTH * padded
            add_patch_gradients(patch, count, scratch, copy, lower, padded, scratch, members, padded)


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
        for chunk in range(far // CHUNK * CHUNK, -1, -CHUNK):
            for at in range(CHUNK_LABELS, CHUNK_LABELS + CHUNK * padded, TILE):
                store(scratch, at, spread(ZERO))
            for place in range(min(chunk + CHUNK - 1, far), chunk - 1, -1):
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
                        place - chunk,
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
                for place in range(chunk, min(chunk + CHUNK, far + 1)):
                    slot = int(tile_slots[first + place])
                    if touched[slot] != 0:
                        source = CHUNK_LABELS + (place - chunk) * padded
                        for c in range(0, padded, TILE):
                            store_past_cache(slot_labels, slot * padded + c, load(scratch, source + c))
