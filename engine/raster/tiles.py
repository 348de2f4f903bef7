"""Which Gaussians each tile draws, front to back.

Visible Gaussians are sorted by depth (least significant digit first, stable, so ties keep the order of their indices), then
dealt out to their tiles in that order. Every pass is split over workers by ranges, and the result does not depend on
how many there are.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from .compiled import compiled, parallel
from .records import DEPTH

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
DIGIT_PASSES = 3


@compiled
def list_visible(first, last, boxes, records, place, slot, keys, ids, slots):
    """Append the visible of Gaussians first to last at ``place``; their tile gradients start at slot ``slots[i]``."""
    bits = records.view(np.uint32)
    for i in range(first, last):
        slots[i] = slot
        tiles = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        if tiles > 0:
            # depths are positive: their bits sort as they do
            keys[place] = bits[i, DEPTH]
            ids[place] = i
            place += 1
            slot += tiles


@parallel
def list_all_visible(workers, boxes, records, counts, keys, ids, slots):
    """keys uint32 [V], ids int32 [V] of the visible in index order; slots int64 [N + 1] running sum of touched tiles."""
    count = boxes.shape[0]
    places = np.zeros(workers, np.int64)
    starts = np.zeros(workers + 1, np.int64)
    for worker in range(workers):
        if worker > 0:
            places[worker] = places[worker - 1] + counts[worker - 1, 0]
        starts[worker + 1] = starts[worker] + counts[worker, 1]
    for worker in prange(workers):
        first = count * worker // workers
        last = count * (worker + 1) // workers
        list_visible(first, last, boxes, records, places[worker], starts[worker], keys, ids, slots)
    slots[count] = starts[workers]


@compiled
def count_digits(first, last, keys, shift, histogram):
    histogram[:] = 0
    for i in range(first, last):
        histogram[(keys[i] >> shift) & np.uint32(DIGITS - 1)] += 1


@compiled
def running_starts(histograms):
    """Counts [workers, bins] become the places where each worker's share of each bin starts; returns the bins' starts."""
    workers, bins = histograms.shape
    starts = np.empty(bins + 1, np.int64)
    total = 0
    for b in range(bins):
        starts[b] = total
        for worker in range(workers):
            own = histograms[worker, b]
            histograms[worker, b] = total
            total += own
    starts[bins] = total
    return starts


@compiled
def deal_digits(first, last, keys, ids, shift, places, keys_out, ids_out):
    for i in range(first, last):
        digit = (keys[i] >> shift) & np.uint32(DIGITS - 1)
        place = places[digit]
        places[digit] = place + 1
        keys_out[place] = keys[i]
        ids_out[place] = ids[i]


@parallel
def sort_by_depth(workers, keys, ids, spare_keys, spare_ids, histograms):
    """Stable sort; the result is in the spare arrays. histograms int64 [workers, DIGITS] is scratch."""
    count = keys.shape[0]
    for digit_pass in range(DIGIT_PASSES):
        shift = np.uint32(DIGIT_BITS * digit_pass)
        for worker in prange(workers):
            count_digits(
                count * worker // workers, count * (worker + 1) // workers, keys, shift, histograms[worker]
            )
        running_starts(histograms)
        for worker in prange(workers):
            deal_digits(
                count * worker // workers,
                count * (worker + 1) // workers,
                keys,
                ids,
                shift,
                histograms[worker],
                spare_keys,
                spare_ids,
            )
        keys, spare_keys = spare_keys, keys
        ids, spare_ids = spare_ids, ids


@compiled
def count_tiles(first, last, order, boxes, columns, histogram):
    histogram[:] = 0
    for k in range(first, last):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                histogram[row * columns + column] += 1


@compiled
def deal_tiles(first, last, order, boxes, slots, columns, places, tile_ids, tile_slots):
    for k in range(first, last):
        i = order[k]
        slot = slots[i]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * columns + column
                place = places[tile]
                places[tile] = place + 1
                tile_ids[place] = i
                tile_slots[place] = slot
                slot += 1


@parallel
def deal_all_tiles(workers, order, boxes, slots, columns, histograms, tile_ids, tile_slots):
    """Fill tile_ids int32 [T] (Gaussian) and tile_slots int32 [T] (where its gradient in that tile goes), tile after tile, front
    to back in each. histograms int64 [workers, tiles] is scratch. Returns the tiles' starts int64 [tiles + 1]."""
    count = order.shape[0]
    for worker in prange(workers):
        count_tiles(
            count * worker // workers,
            count * (worker + 1) // workers,
            order,
            boxes,
            columns,
            histograms[worker],
        )
    starts = running_starts(histograms)
    for worker in prange(workers):
        deal_tiles(
            count * worker // workers,
            count * (worker + 1) // workers,
            order,
            boxes,
            slots,
            columns,
            histograms[worker],
            tile_ids,
            tile_slots,
        )
    return starts
