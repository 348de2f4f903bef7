"""Back-to-front gradients, sixteen pixels at a time. The same steps as ``blend_backward``, its readable twin,
where the equations stand."""

from __future__ import annotations

from typing import Any

from .compiled import Array, compiled
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
from .records import BLUE, CHUNK, DEPTH, GRADIENT_WIDTH, GREEN, L11, OPACITY, RECORD, RED, TILE
from .vector_forward import (
    ALPHA_CAP,
    ALPHA_LEAST,
    ONE,
    PIXELS,
    ROW_STATE,
    ROW_STRIDE,
    S1_LEFT,
    S2,
    THROUGH,
    ZERO,
    F,
    copy_labels,
    padded_channels,
    whiten_rows,
)
from .vectors import (
    bits_of,
    choose,
    exp2,
    fma,
    lane_numbers,
    load,
    load_some,
    lowest_bit,
    minimum,
    spread,
    store,
    take_next,
    totals,
)

# a worker's scratch, in floats; as the forward pass as far as THROUGH
LAST = THROUGH + TILE
BEHIND = LAST + TILE
D_PLANES = BEHIND + TILE  # gradients of red, green, blue, depth
LAST_OF_ROW = ROW_STATE + TILE * ROW_STRIDE
WEIGHTS = LAST_OF_ROW + TILE  # [row, member, pixel]
CHUNK_LABELS = (
    WEIGHTS + TILE * CHUNK * TILE
)  # [member or nobody, padded], then the tile's gradients [pixel, padded]
NOBODY = CHUNK


def scratch_size(channels: int) -> int:
    """Floats of scratch that a worker needs."""
    return CHUNK_LABELS + (CHUNK + 1 + PIXELS) * padded_channels(channels)


@compiled
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
            store(scratch, BEHIND + row, spread(ZERO) - through * load_some(d_alpha, pixel, inside))
            store(scratch, LAST + row, choose(inside, load_some(last_in, pixel, inside), spread(-ONE)))
            store(scratch, D_PLANES + 3 * TILE + row, load_some(d_depth, pixel, inside))
            for plane in range(3):
                store(scratch, D_PLANES + plane * TILE + row, spread(ZERO))
            for x in range(min(TILE, width - left)):
                own = max(own, int(scratch[LAST + row + x]))
                for plane in range(3):
                    scratch[D_PLANES + plane * TILE + row + x] = d_image[3 * (pixel + x) + plane]
        scratch[LAST_OF_ROW + r] = F(own)
        far = max(far, own)
    return far


@compiled
def load_tile_labels(
    left: int, top: int, width: int, height: int, d_labels: Array, channels: int, padded: int, scratch: Array
) -> None:
    tile_labels = CHUNK_LABELS + (CHUNK + 1) * padded
    for r in range(TILE):
        for x in range(TILE):
            at = tile_labels + (r * TILE + x) * padded
            if left + x < width and top + r < height:
                copy_labels((top + r) * width + left + x, d_labels, channels, scratch, at)
            else:
                for c in range(0, padded, TILE):
                    store(scratch, at + c, spread(ZERO))


@compiled
def unblend_gaussian(
    records: Array,
    at: int,
    place: float,
    member: int,
    rows: int,
    scratch: Array,
    counts: Array,
    members: Array,
    gradients: Array,
    slot: int,
) -> None:
    """Step back over one Gaussian on the rows of a mask, and write its gradients."""
    slope = spread(records[at + L11])
    opacity = spread(records[at + OPACITY])
    red, green = spread(records[at + RED]), spread(records[at + GREEN])
    blue, depth = spread(records[at + BLUE]), spread(records[at + DEPTH])
    here = spread(place)
    g0 = g1 = g11 = g2 = g12 = g22 = spread(ZERO)
    d_red = d_green = d_blue = d_depth = spread(ZERO)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        if scratch[LAST_OF_ROW + r] < place:
            continue
        row = r * ROW_STRIDE
        s1 = fma(slope, lane_numbers(), spread(scratch[S1_LEFT + r]))
        s2 = spread(scratch[S2 + r])
        raw = opacity * exp2(spread(ZERO) - fma(s1, s1, s2 * s2))
        alpha = minimum(raw, spread(ALPHA_CAP))
        blended = (alpha >= spread(ALPHA_LEAST)) & (load(scratch, LAST + row) >= here)
        if bits_of(blended) == 0:
            continue
        alpha = choose(blended, alpha, spread(ZERO))
        over = spread(ONE) / (spread(ONE) - alpha)
        before = load(scratch, THROUGH + row) * over
        store(scratch, THROUGH + row, before)
        weight = alpha * before
        image_red = load(scratch, D_PLANES + row)
        image_green = load(scratch, D_PLANES + TILE + row)
        image_blue = load(scratch, D_PLANES + 2 * TILE + row)
        image_depth = load(scratch, D_PLANES + 3 * TILE + row)
        value = fma(red, image_red, fma(green, image_green, fma(blue, image_blue, depth * image_depth)))
        behind = load(scratch, BEHIND + row)
        g = choose(
            raw <= spread(ALPHA_CAP), fma(weight, value, spread(ZERO) - alpha * over * behind), spread(ZERO)
        )
        store(scratch, BEHIND + row, fma(weight, value, behind))
        g_s1 = g * s1
        g0 = g0 + g
        g1 = g1 + g_s1
        g11 = fma(g_s1, s1, g11)
        g2 = fma(g, s2, g2)
        g12 = fma(g_s1, s2, g12)
        g22 = fma(g, s2 * s2, g22)
        d_red = fma(weight, image_red, d_red)
        d_green = fma(weight, image_green, d_green)
        d_blue = fma(weight, image_blue, d_blue)
        d_depth = fma(weight, image_depth, d_depth)
        store(scratch, WEIGHTS + (r * CHUNK + counts[r]) * TILE, weight)
        members[r * CHUNK + counts[r]] = member
        counts[r] += 1
    store(
        gradients,
        slot * GRADIENT_WIDTH,
        totals((g0, g1, g11, g2, g12, g22, d_red, d_green, d_blue, d_depth)),
    )


@compiled
def add_label_gradients(scratch: Array, counts: Array, members: Array, padded: int) -> None:
    """The chunk's label gradients += its weights times the tile's label gradients, row after row."""
    for r in range(TILE):
        count = counts[r]
        counts[r] = 0
        listed = r * CHUNK
        source = CHUNK_LABELS + (CHUNK + 1 + r * TILE) * padded
        while count % 4 != 0:
            members[listed + count] = NOBODY
            store(scratch, WEIGHTS + (listed + count) * TILE, spread(ZERO))
            count += 1
        k = 0
        while k + ROWS <= count:
            m, w = listed + k, WEIGHTS + (listed + k) * TILE
            c = 0
            while c + 3 * BLOCK <= padded:
                unblend_3(scratch, CHUNK_LABELS + c, members, m, scratch, source + c, scratch, w, padded)
                c += 3 * BLOCK
            if c + 2 * BLOCK <= padded:
                unblend_2(scratch, CHUNK_LABELS + c, members, m, scratch, source + c, scratch, w, padded)
            elif c + BLOCK <= padded:
                unblend_1(scratch, CHUNK_LABELS + c, members, m, scratch, source + c, scratch, w, padded)
            k += ROWS
        if k < count:
            m, w = listed + k, WEIGHTS + (listed + k) * TILE
            c = 0
            while c + 3 * BLOCK <= padded:
                unblend_four_3(scratch, CHUNK_LABELS + c, members, m, scratch, source + c, scratch, w, padded)
                c += 3 * BLOCK
            if c + 2 * BLOCK <= padded:
                unblend_four_2(scratch, CHUNK_LABELS + c, members, m, scratch, source + c, scratch, w, padded)
            elif c + BLOCK <= padded:
                unblend_four_1(scratch, CHUNK_LABELS + c, members, m, scratch, source + c, scratch, w, padded)


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
    padded = (channels + TILE - 1) // TILE * TILE
    for r in range(TILE):
        counts[r] = 0
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
        if channels > 0:
            load_tile_labels(left, top, width, height, d_labels, channels, padded, scratch)
        for chunk in range(far // CHUNK * CHUNK, -1, -CHUNK):
            for at in range(CHUNK_LABELS, CHUNK_LABELS + CHUNK * padded, TILE):
                store(scratch, at, spread(ZERO))
            for place in range(min(chunk + CHUNK - 1, far), chunk - 1, -1):
                at = int(tile_ids[first + place]) * RECORD
                slot = int(tile_slots[first + place])
                rows = whiten_rows(records, at, left, top, scratch)
                if rows == 0:
                    touched[slot] = 0
                    continue
                touched[slot] = 1
                unblend_gaussian(
                    records, at, F(place), place - chunk, rows, scratch, counts, members, slot_gradients, slot
                )
            if channels > 0:
                add_label_gradients(scratch, counts, members, padded)
                for place in range(chunk, min(chunk + CHUNK, far + 1)):
                    slot = int(tile_slots[first + place])
                    if touched[slot] != 0:
                        source = CHUNK_LABELS + (place - chunk) * padded
                        for c in range(0, padded, TILE):
                            store(slot_labels, slot * padded + c, load(scratch, source + c))
            else:
                for r in range(TILE):
                    counts[r] = 0
