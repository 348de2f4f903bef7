"""The kernels behind ``layers.decide``: a block of pixels at a time, channel after channel, so that each loop runs
over neighbouring pixels and the processor's vectors do many at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..instances.class_first import LEAST_OF_CLASS, object_of_class
from ..machine.compiled import Array, compiled, parallel_kernel

BLOCK = 128
"""Pixels of one block: its classes and slots together stay in the processor's first cache."""
NOTHING = 1e-3
"""Below this alpha nothing was rendered: the pixel's labels, depth and confidence are 0."""

LEAST_SHARE_OF_CLASS = np.float32(LEAST_OF_CLASS)

FAINT, LEAST_TOTAL, LEAST_SHARE = np.float32(NOTHING), np.float32(1e-8), np.float32(1e-12)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
LN_2 = np.float32(np.log(2))
THIRD, FIFTH, SEVENTH, NINTH = (np.float32(1 / n) for n in (3, 5, 7, 9))
HALF_ROOT_BITS = int(np.float32(np.sqrt(0.5)).view(np.int32))
MANTISSA_BITS = 23


class Columns(NamedTuple):
    """What the channels mean, in the order in which ties are decided. ``of_class`` int64 [C]: the channel of each class
    but void; ``class_ids`` int32 [C]; ``is_thing`` bool [C]; ``of_slot`` int64 [S]: the channel of each slot but spare
    ones; ``slot_ids`` int32 [S]; ``class_of_slot`` int64 [S]: place among the classes, -1 = none; ``one_class``:
    whether an object is of one class throughout."""

    of_class: NDArray[np.int64]
    class_ids: NDArray[np.int32]
    is_thing: NDArray[np.bool_]
    of_slot: NDArray[np.int64]
    slot_ids: NDArray[np.int32]
    class_of_slot: NDArray[np.int64]
    one_class: bool


class Pixels(NamedTuple):
    """A rendering's pixels, float32: ``image`` [P, 3], ``alpha`` [P], ``depth`` [P], ``classes`` [P, >= C], ``slots``
    [P, >= S]."""

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    classes: NDArray[np.float32]
    slots: NDArray[np.float32]


class Decided(NamedTuple):
    """What is written, as ``PanopticLayers`` has it: ``combined`` [P, 4], the others [P]."""

    combined: NDArray[np.float32]
    depth: NDArray[np.float32]
    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]
    confidence: NDArray[np.float32]
    entropy: NDArray[np.float32]


@parallel_kernel
def decide_blocks(
    worker: int, workers: int, pixels: Any, columns: Any, linear_light: Array, scratch: Array, decided: Any
) -> None:
    """Every ``workers``-th block. ``linear_light`` float32 [N + 1]: linear values of 0, 1/N, ... 1 (sRGB-encoded);
    ``scratch`` float32 [workers, 3 C + 2, BLOCK]."""
    count = len(pixels.alpha)
    own, classes = scratch[worker], len(columns.of_class)
    likely, likeliest = own[3 * classes], own[3 * classes + 1]
    share, logarithm, exponent = own[:classes], own[classes : 2 * classes], own[2 * classes : 3 * classes]
    for start in range(worker * BLOCK, count, workers * BLOCK):
        size = min(BLOCK, count - start)
        transpose(pixels.classes, start, size, columns.of_class, share)
        to_shares(share, size, likely)
        largest(share, size, likely, likeliest)
        choose(pixels, columns, start, size, share, likeliest, decided)
        natural_logarithm(share.reshape(-1), exponent.reshape(-1), logarithm.reshape(-1))
        normalised_entropy(share, logarithm, size, likely, pixels.alpha[start:], decided.entropy[start:])
        combine(pixels, start, size, linear_light, decided.combined)


@compiled
def transpose(coverage: Array, start: int, size: int, columns: Array, out: Array) -> None:
    """Wanted channels of a block of pixels to rows of ``out`` [channels, BLOCK]."""
    for x in range(size):
        shown = coverage[start + x]
        for place in range(len(columns)):
            out[place, x] = shown[columns[place]]


@compiled
def to_shares(coverage: Array, size: int, total: Array) -> None:
    """Coverage of the classes to their probabilities, in place."""
    total[:size] = ZERO
    for number in range(len(coverage)):
        row = coverage[number]
        for x in range(size):
            total[x] += row[x]
    for x in range(size):
        total[x] = max(total[x], LEAST_TOTAL)
    for number in range(len(coverage)):
        row = coverage[number]
        for x in range(size):
            row[x] /= total[x]


@compiled
def largest(rows: Array, size: int, value: Array, place: Array) -> None:
    """The largest of each column and which row has it, the first of several; 0 and row 0 where none is above 0."""
    value[:size] = ZERO
    place[:size] = ZERO
    for number in range(len(rows)):
        row, name = rows[number], np.float32(number)
        for x in range(size):
            here, best, holder = row[x], value[x], place[x]
            value[x] = here if here > best else best
            place[x] = name if here > best else holder


@compiled
def best_slot(pixels: Any, columns: Any, pixel: int, place: int) -> int:
    """The slot that a pixel of class ``place`` shows, the first of several, -1 for no object.

    Where objects are of one class throughout, it is that of ``class_first``. Else it is the one of largest coverage, if
    no object has less.
    """
    coverage, best, most, instances = pixels.slots[pixel], -1, ZERO, ZERO
    if columns.one_class:
        least = LEAST_SHARE_OF_CLASS * pixels.classes[pixel, columns.of_class[place]]
        return object_of_class(coverage, columns.of_slot, columns.class_of_slot, place, least)
    for slot in range(len(columns.of_slot)):
        weight = coverage[columns.of_slot[slot]]
        instances += weight
        if weight > most:
            best, most = slot, weight
    return best if most > pixels.alpha[pixel] - instances else -1


@compiled
def choose(pixels: Any, columns: Any, start: int, size: int, share: Array, likeliest: Array, decided: Any) -> None:
    """Class, instance, confidence and depth of a block. ``share`` [C, BLOCK], ``likeliest`` [BLOCK] its largest row."""
    for x in range(size):
        pixel, place, instance = start + x, int(likeliest[x]), 0
        if columns.is_thing[place]:
            slot = best_slot(pixels, columns, pixel, place)
            if slot >= 0:
                instance = columns.slot_ids[slot]
        rendered = pixels.alpha[pixel] >= FAINT
        decided.semantic[pixel] = columns.class_ids[place] if rendered else 0
        decided.instance[pixel] = instance if rendered else 0
        decided.confidence[pixel] = share[place, x] if rendered else ZERO
        decided.depth[pixel] = pixels.depth[pixel] if rendered else ZERO


@compiled
def natural_logarithm(values: Array, exponent: Array, out: Array) -> None:
    """The logarithm of values in [0, 1], 1e-12 for those below. The library's would take the values one by one.

    A value is m 2^k with m in [sqrt(1/2), sqrt(2)), and log m = 2 artanh s for s = (m - 1) / (m + 1), of which five
    terms reach float32's precision. ``exponent`` is scratch.
    """
    bits = out.view(np.int32)
    for x in range(len(values)):
        out[x] = max(values[x], LEAST_SHARE)
    for x in range(len(values)):
        word = bits[x]
        k = np.int32(np.int32(word - HALF_ROOT_BITS) >> MANTISSA_BITS)
        exponent[x] = np.float32(k)
        bits[x] = np.int32(word - np.int32(k << MANTISSA_BITS))
    for x in range(len(values)):
        s = (out[x] - ONE) / (out[x] + ONE)
        z = s * s
        series = ONE + z * (THIRD + z * (FIFTH + z * (SEVENTH + z * NINTH)))
        out[x] = exponent[x] * LN_2 + TWO * s * series


@compiled
def normalised_entropy(share: Array, logarithm: Array, size: int, total: Array, alpha: Array, entropy: Array) -> None:
    """Entropy of the probabilities over the logarithm of their number, 0 where nothing was rendered."""
    total[:size] = ZERO
    for number in range(len(share)):
        row, logarithms = share[number], logarithm[number]
        for x in range(size):
            total[x] -= row[x] * logarithms[x]
    scale = ONE / np.float32(np.log(max(len(share), 2)))
    for x in range(size):
        entropy[x] = total[x] * scale if alpha[x] >= FAINT else ZERO


@compiled
def combine(pixels: Any, start: int, size: int, linear_light: Array, combined: Array) -> None:
    """Colour in linear light, between the two nearest of the table, and alpha."""
    steps = len(linear_light) - 1
    for pixel in range(start, start + size):
        for channel in range(3):
            value = min(max(pixels.image[pixel, channel], ZERO), ONE) * np.float32(steps)
            low = min(int(value), steps - 1)
            part = value - np.float32(low)
            combined[pixel, channel] = linear_light[low] + part * (linear_light[low + 1] - linear_light[low])
        combined[pixel, 3] = min(max(pixels.alpha[pixel], ZERO), ONE)
