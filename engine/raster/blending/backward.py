"""Back-to-front gradients of the blending, a patch of sixteen pixels at a time.

Walking back, T_i = T_{i+1} / (1 - alpha_i), and one running value per pixel is all that is needed. Let v_i =
colour_i . dL/dimage + z_i * dL/ddepth. Behind Gaussian i lies B_i = alpha_{i+1} v_{i+1} + (1 - alpha_{i+1}) B_{i+1},
and dL/d(ln alpha_i) = alpha_i T_i (v_i - B_i). At the far end B = -dL/dalpha, as if a last Gaussian closed the pixel:
this stays exact where the final transmittance is tiny.

The Gaussians are processed one after another, each on all its patches of the tile, so that its sums stay in registers;
the patches' state is in the first-level cache. Each Gaussian's gradient in each tile has its own place; ``gather`` adds
them in order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined, parallel_kernel
from ...machine.intrinsics import fetch_add
from ...machine.vector_functions import exp2_x4
from ...machine.vector_shuffles import horizontal_sums
from ...machine.vectors import (
    broadcast,
    broadcast_load,
    fma,
    fnmadd,
    get,
    load,
    load_pairs,
    minimum,
    movemask,
    prefetch,
    put,
    select,
    store,
    store_nontemporal,
    trailing_zeros,
)
from ..arrays import Intersections, IsectGradients, PixelGradients, Scratch, Size, Tile
from ..records import (
    BACKWARD_BATCH,
    BLUE,
    DEPTH,
    GRADIENT_WIDTH,
    GREEN,
    L11,
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
    TRANSMITTANCE,
    WEIGHTS,
    WHITENED,
    PatchLists,
    load_tile,
    start_worker,
    whiten_tile,
)
from .batch import AHEAD
from .forward import ALPHA_CAP, ALPHA_LEAST, take_four
from .forward_strip import ONE, ZERO, F
from .label_gradients import add_label_gradients, write_label_gradients


@inlined
def whitened(patch: int, slope: Any, scratch: Array, own: int) -> Any:
    """s1 on a patch."""
    row, side = patch & -2, patch & 1
    return fma(slope, load(scratch, COLUMNS + side * TILE), load_pairs(scratch, own + S1_LEFT + row))


@inlined
def exponent_of(patch: int, slope: Any, scratch: Array, own: int) -> Any:
    """log2 of the Gaussian's alpha on a patch."""
    s1 = whitened(patch, slope, scratch, own)
    return fnmadd(s1, s1, load_pairs(scratch, own + EXPONENTS + (patch & -2)))


@inlined
def blended_alpha(patch: int, raw: Any, here: Any, scratch: Array) -> Any:
    """The alpha before the cap if the forward pass blended it, otherwise 0."""
    blended = (raw >= broadcast(ALPHA_LEAST)) & (load(scratch, LAST + patch * PATCH_STRIDE) >= here)
    return select(blended, raw, broadcast(ZERO))


@inlined
def keep_alpha(patch: int, raw: Any, scratch: Array) -> None:
    store(scratch, RAW_ALPHAS + patch * TILE, raw)
    store(scratch, OVERS + patch * TILE, broadcast(ONE) / (broadcast(ONE) - minimum(raw, broadcast(ALPHA_CAP))))


@device_function
def fill_alphas(slope: float, place: float, patches: int, scratch: Array, own: int) -> None:
    """Fill RAW_ALPHAS and OVERS on the patches of a mask, with the same bits as in the forward pass; four at a time, so
    that none waits for another."""
    slopes, here = broadcast(slope), broadcast(place)
    while patches != 0:
        (p0, p1, p2, p3), patches = take_four(patches, NO_PATCH)
        e0, e1 = exponent_of(p0, slopes, scratch, own), exponent_of(p1, slopes, scratch, own)
        e2, e3 = exponent_of(p2, slopes, scratch, own), exponent_of(p3, slopes, scratch, own)
        raw0, raw1, raw2, raw3 = exp2_x4(e0, e1, e2, e3)
        raw0, raw1 = blended_alpha(p0, raw0, here, scratch), blended_alpha(p1, raw1, here, scratch)
        raw2, raw3 = blended_alpha(p2, raw2, here, scratch), blended_alpha(p3, raw3, here, scratch)
        keep_alpha(p0, raw0, scratch)
        keep_alpha(p1, raw1, scratch)
        keep_alpha(p2, raw2, scratch)
        keep_alpha(p3, raw3, scratch)


@device_function
def blend_gaussian_backward(
    records: Array, at: int, member: int, patches: int, scratch: Array, own: int, lists: PatchLists
) -> Any:
    """Step back over one Gaussian on the patches of a mask. Returns its gradients, as columns of lanes."""
    slope = broadcast_load(records, at + L11)
    red, green = broadcast_load(records, at + RED), broadcast_load(records, at + GREEN)
    blue, depth = broadcast_load(records, at + BLUE), broadcast_load(records, at + DEPTH)
    g0 = g1 = g11 = g2 = g12 = g22 = broadcast(ZERO)
    d_red = d_green = d_blue = d_depth = broadcast(ZERO)
    while patches != 0:
        patch = trailing_zeros(patches)
        patches &= patches - 1
        state, row = patch * PATCH_STRIDE, patch & -2
        raw = load(scratch, RAW_ALPHAS + patch * TILE)
        alpha = minimum(raw, broadcast(ALPHA_CAP))
        before = load(scratch, TRANSMITTANCE + state) * load(scratch, OVERS + patch * TILE)
        store(scratch, TRANSMITTANCE + state, before)
        weight = alpha * before
        image_red = load(scratch, D_PLANES + state)
        image_green = load(scratch, D_PLANES + TILE + state)
        image_blue = load(scratch, D_PLANES + 2 * TILE + state)
        image_depth = load(scratch, D_PLANES + 3 * TILE + state)
        value = fma(red, image_red, fma(green, image_green, fma(blue, image_blue, depth * image_depth)))
        behind = load(scratch, BEHIND + state)
        difference = value - behind
        store(scratch, BEHIND + state, fma(alpha, difference, behind))
        g = select(raw <= broadcast(ALPHA_CAP), weight * difference, broadcast(ZERO))
        s1, s2 = whitened(patch, slope, scratch, own), load_pairs(scratch, own + S2 + row)
        g_s1 = g * s1
        g0 = g0 + g
        g1 = g1 + g_s1
        g11 = fma(g_s1, s1, g11)
        g2 = fma(g, s2, g2)
        g12 = fma(g_s1, s2, g12)
        g22 = fma(g, load_pairs(scratch, own + S2_SQUARED + row), g22)
        d_red = fma(weight, image_red, d_red)
        d_green = fma(weight, image_green, d_green)
        d_blue = fma(weight, image_blue, d_blue)
        d_depth = fma(weight, image_depth, d_depth)
        if lists.wanted:
            # If nothing was blended, the next one overwrites it: cheaper than a branch that cannot be predicted.
            count = get(lists.counts, patch)
            store(scratch, WEIGHTS + (patch * LISTED + count) * TILE, weight)
            put(lists.members, patch * LISTED + count, np.int32(member))
            put(lists.counts, patch, count + int(movemask(raw > broadcast(ZERO)) != 0))
    return horizontal_sums((g0, g1, g11, g2, g12, g22, d_red, d_green, d_blue, d_depth))


@parallel_kernel
def blend_backward(
    worker: int,
    workers: int,
    isects: Intersections,
    records: Array,
    pixels: PixelGradients,
    size: Size,
    out: IsectGradients,
    scratches: Scratch,
) -> None:
    """Process one tile after another until none is left."""
    scratch, counts = scratches.floats[worker], scratches.counts[worker]
    lists = PatchLists(counts, scratches.members[worker], size.channels > 0)
    starts, flatten_ids, isect_ids = isects.isect_offsets, isects.flatten_ids, isects.isect_ids
    channels, touched = size.channels, out.touched
    columns, tiles = (size.width + TILE - 1) // TILE, starts.shape[0] - 1
    padded = padded_channels(channels)
    start_worker(scratch, counts)
    while True:
        number = fetch_add(scratches.next_one)
        if number >= tiles:
            break
        left, top, first = number % columns * TILE, number // columns * TILE, starts[number]
        tile = Tile(left, top, first, starts[number + 1] - first)
        far = load_tile(tile, size, pixels, scratch)
        for k in range(first + far + 1, starts[number + 1]):
            touched[isect_ids[k]] = 0
        if far < 0:
            continue
        # each Gaussian is whitened during the one before it, so that the patches it touches are known in time
        own = 0
        patches = whiten_tile(records, int(get(flatten_ids, first + far)) * RECORD, tile, scratch, own)
        for batch in range(far // BACKWARD_BATCH * BACKWARD_BATCH, -1, -BACKWARD_BATCH):
            for at in range(BATCH_LABELS, BATCH_LABELS + BACKWARD_BATCH * padded, TILE):
                store(scratch, at, broadcast(ZERO))
            for place in range(min(batch + BACKWARD_BATCH - 1, far), batch - 1, -1):
                touching = patches & movemask(load(scratch, LAST_OF_PATCH) >= broadcast(F(place)))
                at = int(get(flatten_ids, first + place)) * RECORD
                following = int(get(flatten_ids, first + max(place - 1, 0))) * RECORD
                prefetch(records, int(get(flatten_ids, first + max(place - AHEAD, 0))) * RECORD)
                patches = whiten_tile(records, following, tile, scratch, WHITENED - own)
                isect = int(get(isect_ids, first + place))
                touched[isect] = touching != 0
                if touching != 0:
                    fill_alphas(get(records, at + L11), F(place), touching, scratch, own)
                    sums = blend_gaussian_backward(records, at, place - batch, touching, scratch, own, lists)
                    store_nontemporal(out.values, isect * GRADIENT_WIDTH, sums)
                own = WHITENED - own
            if channels > 0:
                add_label_gradients(tile, size, pixels.labels, scratch, lists)
                count = min(BACKWARD_BATCH, far + 1 - batch)
                write_label_gradients(first + batch, count, isect_ids, scratch, out, padded)
