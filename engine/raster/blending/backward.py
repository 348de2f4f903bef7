"""The backward pass of the blending, back to front, a patch of 8 x 2 pixels at a time.

Going back, T_i = T_{i+1} / (1 - alpha_i), so each pixel keeps only its current transmittance. With v_i = colour_i .
dL/dimage + z_i * dL/ddepth, what lies behind Gaussian i is B_i = alpha_{i+1} v_{i+1} + (1 - alpha_{i+1}) B_{i+1}, and
dL/d(ln alpha_i) = alpha_i T_i (v_i - B_i). It starts with B = -dL/dalpha, as if a last Gaussian closed the pixel, which
stays exact where the final transmittance is tiny.

One Gaussian after another is processed on all its patches of a tile, so that its sums stay in registers; the patches'
state stays in the first-level cache. Each pair of Gaussian and tile has its own slot for gradients; ``gather`` adds the
slots in a fixed order."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...machine import vectors as v
from ...machine.compiled import Array, device_function, inlined, parallel_kernel
from ...machine.matrix_product import Factors, ListedRows, Rows, add_product
from ...machine.vector_shuffles import deinterleave3, horizontal_max, horizontal_sums, interleave2
from .. import conventions
from ..arrays import Blended, Intersections, IsectGradients, Scratch, Size, Tile
from ..conventions import BACKWARD_BATCH, GRADIENT_WIDTH, PATCH_WIDTH, RECORD, TILE, padded_channels
from .batch import AHEAD, PATCHES, halves_touched, origin_of
from .forward import ALPHA_CAP, ALPHA_LEAST, ONE, ZERO, F, copy_labels, take_four

# The label gradients of a batch of Gaussians: its weights on each patch times the gradients of the pixels' labels.

PAD_INDEX = BACKWARD_BATCH
"""Index used where there is no member. Nothing reads its labels."""


@device_function
def copy_label_gradients(tile: Tile, size: Size, d_labels: Array, channels: Array, count: int, scratch: Array) -> None:
    """Copy the gradients of a tile's labels to the scratch, patch by patch, 0 outside the image. ``d_labels`` [P * C]
    has all channels; ``channels`` int32 [count] lists those to copy."""
    padded = padded_channels(count)
    for patch in range(PATCHES):
        top, left = tile.top + (patch & -2), tile.left + (patch & 1) * PATCH_WIDTH
        for pixel in range(TILE):
            row, column = top + (pixel & 1), left + (pixel >> 1)
            at = BATCH_LABELS + (BACKWARD_BATCH + 1 + patch * TILE + pixel) * padded
            for c in range(0, padded, TILE):
                v.store(scratch, at + c, v.broadcast(ZERO))
            if row < size.height and column < size.width:
                number = row * size.width + column
                if count == size.channels:
                    copy_labels(number, d_labels, count, scratch, at)
                else:
                    for c in range(count):
                        scratch[at + c] = d_labels[number * size.channels + channels[c]]


@device_function
def add_label_gradients(padded: int, scratch: Array, lists: PatchLists) -> None:
    """Empty the lists, and add to each listed Gaussian's label gradients its patch's sum of weight * label gradient."""
    for patch in range(PATCHES):
        count, listed = v.get(lists.counts, patch), patch * LISTED
        if count == 0:
            continue
        for missing in range(count, count + 3):  # the product below takes members in fours
            v.put(lists.members, listed + missing, np.int32(PAD_INDEX))
            v.store(scratch, WEIGHTS + (listed + missing) * TILE, v.broadcast(ZERO))
        out = ListedRows(scratch, BATCH_LABELS, padded, lists.members, listed)
        weights = Factors(scratch, WEIGHTS + listed * TILE, TILE, 1)
        source = Rows(scratch, BATCH_LABELS + (BACKWARD_BATCH + 1 + patch * TILE) * padded, padded)
        add_product(out, weights, source, (count + 3) & -4, padded, TILE)
        v.put(lists.counts, patch, 0)


# A tile in the backward pass, as patches: where a worker keeps it, and how it is read from the image.

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
# [member or PAD_INDEX, padded], then the label gradients of the tile's pixels [patch, pixel, padded]
BATCH_LABELS = WEIGHTS + PATCHES * LISTED * TILE
assert PATCHES * LISTED <= conventions.MEMBERS
NO_PATCH = PATCHES
"""A dummy patch that fills up a group of four. Nothing is ever blended on it."""
EVEN = 0x5555
"""The even bits in a bit mask of patches: those of left patches. Bit 2 p is also that of the strip's first row, 2 p."""


class PatchLists(NamedTuple):
    """Which Gaussians of a batch were blended on each patch of the tile: ``counts`` int64 [PATCHES] how many,
    ``members`` int32 [PATCHES * LISTED] their indices in the batch; their weights are in the scratch. Nothing is listed
    unless ``wanted``, which is False in a tile where no label has a gradient."""

    counts: Array
    members: Array
    wanted: bool


def backward_scratch_size(channels: int) -> int:
    """Return the floats of scratch per worker; ``channels`` is the largest number with a gradient in any tile."""
    floats: int = BATCH_LABELS + (BACKWARD_BATCH + 1 + TILE * TILE) * padded_channels(channels)
    return floats


@device_function
def start_worker(scratch: Array, counts: Array) -> None:
    """Initialise a worker's scratch: empty lists, and the dummy patch NO_PATCH."""
    for at in range(PATCH_STATE):
        v.put(scratch, at, ZERO)
    left, right = interleave2(v.lane_numbers(), v.lane_numbers())
    v.store(scratch, COLUMNS, left)
    v.store(scratch, COLUMNS + TILE, right)
    for at in range(PATCH_STATE + NO_PATCH * PATCH_STRIDE, PATCH_STATE + (NO_PATCH + 1) * PATCH_STRIDE):
        v.put(scratch, at, ZERO)
    v.store(scratch, LAST + NO_PATCH * PATCH_STRIDE, v.broadcast(-ONE))
    v.store(scratch, TRANSMITTANCE + NO_PATCH * PATCH_STRIDE, v.broadcast(ONE))
    for patch in range(PATCHES):
        v.put(counts, patch, 0)


@inlined
def store_strip(upper: Any, lower: Any, at: int, scratch: Array) -> None:
    """Store values of an ``upper`` and a ``lower`` row at scratch[at:], in the layout of the strip's two patches."""
    left, right = interleave2(upper, lower)
    v.store(scratch, at, left)
    v.store(scratch, at + PATCH_STRIDE, right)


@device_function
def load_tile(tile: Tile, size: Size, pixels: Blended, scratch: Array) -> Any:
    """Load the pixels' state behind the last Gaussian. Return the largest index blended in the tile, -1 = none."""
    left, top, width, height = tile.left, tile.top, size.width, size.height
    far = -1
    columns = min(TILE, width - left)
    for patch in range(0, PATCHES, 2):
        row = top + patch
        at = patch * PATCH_STRIDE
        pixel, below = row * width + left, (row + 1) * width + left
        # outside there are no columns
        upper_columns, lower_columns = columns if row < height else 0, columns if row + 1 < height else 0
        upper = v.lane_numbers() < v.broadcast(F(upper_columns))
        lower = v.lane_numbers() < v.broadcast(F(lower_columns))
        upper_final = v.select(upper, v.masked_load(pixels.final, pixel, upper), v.broadcast(ONE))
        lower_final = v.select(lower, v.masked_load(pixels.final, below, lower), v.broadcast(ONE))
        store_strip(upper_final, lower_final, TRANSMITTANCE + at, scratch)
        upper_alpha, lower_alpha = v.masked_load(pixels.alpha, pixel, upper), v.masked_load(pixels.alpha, below, lower)
        nothing = v.broadcast(ZERO)
        store_strip(nothing - upper_alpha, nothing - lower_alpha, BEHIND + at, scratch)  # -dL/dalpha
        upper_last = v.select(upper, v.masked_load(pixels.last, pixel, upper), v.broadcast(-ONE))
        lower_last = v.select(lower, v.masked_load(pixels.last, below, lower), v.broadcast(-ONE))
        store_strip(upper_last, lower_last, LAST + at, scratch)
        upper_red, upper_green, upper_blue = colours_of(3 * pixel, 3 * upper_columns, pixels.image)
        lower_red, lower_green, lower_blue = colours_of(3 * below, 3 * lower_columns, pixels.image)
        store_strip(upper_red, lower_red, D_PLANES + at, scratch)
        store_strip(upper_green, lower_green, D_PLANES + TILE + at, scratch)
        store_strip(upper_blue, lower_blue, D_PLANES + 2 * TILE + at, scratch)
        upper_depth, lower_depth = v.masked_load(pixels.depth, pixel, upper), v.masked_load(pixels.depth, below, lower)
        store_strip(upper_depth, lower_depth, D_PLANES + 3 * TILE + at, scratch)
        for each in (patch, patch + 1):
            own = horizontal_max(v.load(scratch, LAST + each * PATCH_STRIDE))
            v.put(scratch, LAST_OF_PATCH + each, own)
            far = max(far, int(own))
    return far


@inlined
def colours_of(source: int, floats: int, d_image: Array) -> Any:
    """Load ``floats`` values (r, g, b, r, ...) from index ``source`` on as three vectors: red, green, blue."""
    return deinterleave3(
        v.masked_load(d_image, source, v.lane_numbers() < v.broadcast(F(floats))),
        v.masked_load(d_image, source + TILE, v.lane_numbers() < v.broadcast(F(floats - TILE))),
        v.masked_load(d_image, source + 2 * TILE, v.lane_numbers() < v.broadcast(F(floats - 2 * TILE))),
    )


@device_function
def whiten_tile(records: Array, at: int, tile: Tile, scratch: Array, own: int) -> Any:
    """Compute the whitened coordinates of one Gaussian on a tile's rows, the same bits as in the forward pass, into the
    fields S1_LEFT, S2, S2_SQUARED and EXPONENTS of scratch[own:]. Return a bit mask of the patches that it touches."""
    origin_s1, origin_s2 = origin_of(records, at, tile)
    s1 = v.fma(v.broadcast_load(records, at + conventions.L12), v.lane_numbers(), v.broadcast(origin_s1))
    s2 = v.fma(v.broadcast_load(records, at + conventions.L22), v.lane_numbers(), v.broadcast(origin_s2))
    log_opacity = v.broadcast_load(records, at + conventions.LOG_OPACITY)
    square = s2 * s2
    v.store(scratch, own + S1_LEFT, s1)
    v.store(scratch, own + S2, s2)
    v.store(scratch, own + S2_SQUARED, square)
    v.store(scratch, own + EXPONENTS, log_opacity - square)
    reach = log_opacity + v.broadcast(conventions.REACH_OVER_LOG_OPACITY)
    on_left, on_right = halves_touched(s1, v.broadcast_load(records, at + conventions.L11), square, reach)
    return strips_of(on_left) | (strips_of(on_right) << 1)


@inlined
def strips_of(mask: int) -> int:
    """Return a bit mask of strips: bit 2 p is set if ``mask``, a bit mask of rows, has row 2 p or row 2 p + 1."""
    return (mask | (mask >> 1)) & EVEN


@inlined
def whitened(patch: int, slope: Any, scratch: Array, own: int) -> Any:
    """Return s1 (see `conventions`) of a patch's pixels, for the Gaussian at scratch[own:] with L11 = ``slope``."""
    row, side = patch & -2, patch & 1
    return v.fma(slope, v.load(scratch, COLUMNS + side * TILE), v.load_pairs(scratch, own + S1_LEFT + row))


@inlined
def exponent_of(patch: int, slope: Any, scratch: Array, own: int) -> Any:
    """Return log2 of the alpha of the Gaussian whitened at scratch[own:], with L11 = ``slope``, at a patch's pixels."""
    s1 = whitened(patch, slope, scratch, own)
    return v.fnmadd(s1, s1, v.load_pairs(scratch, own + EXPONENTS + (patch & -2)))


@inlined
def blended_alpha(patch: int, raw: Any, here: Any, scratch: Array) -> Any:
    """Return ``raw`` alpha, not capped, where a patch's pixels blended the Gaussian at index ``here``, else 0."""
    blended = (raw >= v.broadcast(ALPHA_LEAST)) & (v.load(scratch, LAST + patch * PATCH_STRIDE) >= here)
    return v.select(blended, raw, v.broadcast(ZERO))


@inlined
def keep_alpha(patch: int, raw: Any, scratch: Array) -> None:
    one = v.broadcast(ONE)
    v.store(scratch, RAW_ALPHAS + patch * TILE, raw)
    v.store(scratch, OVERS + patch * TILE, one / (one - v.minimum(raw, v.broadcast(ALPHA_CAP))))


@device_function
def fill_alphas(slope: float, index: float, patches: int, scratch: Array, own: int) -> None:
    """Compute a Gaussian's RAW_ALPHAS and OVERS, 1 / (1 - alpha), on the patches in the bit mask, the same bits as in
    the forward pass. ``index`` is its place in the tile's list. Patches are taken in fours, for speed."""
    slopes, here = v.broadcast(slope), v.broadcast(index)
    while patches != 0:
        (p0, p1, p2, p3), patches = take_four(patches, NO_PATCH)
        e0, e1 = exponent_of(p0, slopes, scratch, own), exponent_of(p1, slopes, scratch, own)
        e2, e3 = exponent_of(p2, slopes, scratch, own), exponent_of(p3, slopes, scratch, own)
        raw0, raw1, raw2, raw3 = v.exp2_x4(e0, e1, e2, e3)
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
    """Undo the blending of the Gaussian whose record is at records[at:], the batch's ``member``, on the patches in the
    bit mask. Return its gradients as one vector, and add the Gaussian to the patches' ``lists`` if they are wanted."""
    slope = v.broadcast_load(records, at + conventions.L11)
    red, green = v.broadcast_load(records, at + conventions.RED), v.broadcast_load(records, at + conventions.GREEN)
    blue, depth = v.broadcast_load(records, at + conventions.BLUE), v.broadcast_load(records, at + conventions.DEPTH)
    g0 = g1 = g11 = g2 = g12 = g22 = v.broadcast(ZERO)
    d_red = d_green = d_blue = d_depth = v.broadcast(ZERO)
    while patches != 0:
        patch = v.trailing_zeros(patches)
        patches &= patches - 1
        state, row = patch * PATCH_STRIDE, patch & -2
        raw = v.load(scratch, RAW_ALPHAS + patch * TILE)
        alpha = v.minimum(raw, v.broadcast(ALPHA_CAP))
        before = v.load(scratch, TRANSMITTANCE + state) * v.load(scratch, OVERS + patch * TILE)  # T_i+1 / (1 - alpha_i)
        v.store(scratch, TRANSMITTANCE + state, before)
        weight = alpha * before
        image_red = v.load(scratch, D_PLANES + state)
        image_green = v.load(scratch, D_PLANES + TILE + state)
        image_blue = v.load(scratch, D_PLANES + 2 * TILE + state)
        image_depth = v.load(scratch, D_PLANES + 3 * TILE + state)
        value = v.fma(red, image_red, v.fma(green, image_green, v.fma(blue, image_blue, depth * image_depth)))
        behind = v.load(scratch, BEHIND + state)
        difference = value - behind
        v.store(scratch, BEHIND + state, v.fma(alpha, difference, behind))
        # a capped alpha has no slope
        g = v.select(raw <= v.broadcast(ALPHA_CAP), weight * difference, v.broadcast(ZERO))
        s1, s2 = whitened(patch, slope, scratch, own), v.load_pairs(scratch, own + S2 + row)
        g_s1 = g * s1
        g0 = g0 + g
        g1 = g1 + g_s1
        g11 = v.fma(g_s1, s1, g11)
        g2 = v.fma(g, s2, g2)
        g12 = v.fma(g_s1, s2, g12)
        g22 = v.fma(g, v.load_pairs(scratch, own + S2_SQUARED + row), g22)
        d_red = v.fma(weight, image_red, d_red)
        d_green = v.fma(weight, image_green, d_green)
        d_blue = v.fma(weight, image_blue, d_blue)
        d_depth = v.fma(weight, image_depth, d_depth)
        if lists.wanted:
            # If nothing was blended, the next one overwrites it: cheaper than a branch that cannot be predicted.
            count = v.get(lists.counts, patch)
            v.store(scratch, WEIGHTS + (patch * LISTED + count) * TILE, weight)
            v.put(lists.members, patch * LISTED + count, np.int32(member))
            v.put(lists.counts, patch, count + int(v.movemask(raw > v.broadcast(ZERO)) != 0))
    return horizontal_sums((g0, g1, g11, g2, g12, g22, d_red, d_green, d_blue, d_depth))


@parallel_kernel
def blend_backward(
    worker: int, workers: int, isects: Intersections, records: Array, pixels: Blended, size: Size,
    out: IsectGradients, scratches: Scratch,
) -> None:  # fmt: skip
    """Compute all intersections' gradients into ``out``. Each worker takes tile after tile until none is left."""
    scratch, counts = scratches.floats[worker], scratches.counts[worker]
    used, starts, flatten_ids, isect_ids = out.used, isects.isect_offsets, isects.flatten_ids, isects.isect_ids
    columns, tiles = (size.width + TILE - 1) // TILE, starts.shape[0] - 1
    start_worker(scratch, counts)
    while True:
        number = v.fetch_add(scratches.next_one)
        if number >= tiles:
            break
        left, top, first = number % columns * TILE, number // columns * TILE, starts[number]
        tile = Tile(left, top, first, starts[number + 1] - first)
        far = load_tile(tile, size, pixels, scratch)
        for k in range(first + far + 1, starts[number + 1]):  # nothing of these was blended
            out.tiles[isect_ids[k]] = -1
        if far < 0:
            continue
        channels = used.counts[number]
        padded = padded_channels(channels)
        lists = PatchLists(counts, scratches.members[worker], channels > 0)
        if channels > 0:
            own_channels = used.channels[number * size.channels : number * size.channels + channels]
            copy_label_gradients(tile, size, pixels.labels, own_channels, channels, scratch)
        # each Gaussian is whitened during the one before it, so that the patches it touches are known in time
        own = 0
        patches = whiten_tile(records, int(v.get(flatten_ids, first + far)) * RECORD, tile, scratch, own)
        for batch in range(far // BACKWARD_BATCH * BACKWARD_BATCH, -1, -BACKWARD_BATCH):
            for at in range(BATCH_LABELS, BATCH_LABELS + BACKWARD_BATCH * padded, TILE):
                v.store(scratch, at, v.broadcast(ZERO))
            for index in range(min(batch + BACKWARD_BATCH - 1, far), batch - 1, -1):
                touching = patches & v.movemask(v.load(scratch, LAST_OF_PATCH) >= v.broadcast(F(index)))
                at = int(v.get(flatten_ids, first + index)) * RECORD
                following = int(v.get(flatten_ids, first + max(index - 1, 0))) * RECORD  # at the front itself, unused
                v.prefetch(records, int(v.get(flatten_ids, first + max(index - AHEAD, 0))) * RECORD)
                patches = whiten_tile(records, following, tile, scratch, WHITENED - own)
                isect = int(v.get(isect_ids, first + index))
                out.tiles[isect] = number if touching != 0 else -1
                if touching != 0:
                    fill_alphas(v.get(records, at + conventions.L11), F(index), touching, scratch, own)
                    sums = blend_gaussian_backward(records, at, index - batch, touching, scratch, own, lists)
                    v.store_nontemporal(out.values, isect * GRADIENT_WIDTH, sums)  # only `gather` reads it
                own = WHITENED - own
            if channels > 0:
                add_label_gradients(padded, scratch, lists)
                for member in range(min(BACKWARD_BATCH, far + 1 - batch)):
                    isect = int(v.get(isect_ids, first + batch + member))
                    if v.get(out.tiles, isect) >= 0:
                        source = BATCH_LABELS + member * padded
                        for c in range(0, padded, TILE):
                            v.store_nontemporal(out.labels, isect * used.padded + c, v.load(scratch, source + c))
