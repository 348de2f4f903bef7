"""Turn soft coverage into layers: which class and which instance a pixel shows, and with what probability."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..instances.panoptic_labels import LEAST_OF_CLASS, object_of_class
from ..machine import memory
from ..machine.compiled import Array, device_function, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from ..model.neural_gaussians import PanopticRendering
from ..scene import VOID, ClassTable

CHUNK = 4096
"""Pixels that a worker takes at a time."""
NOTHING = 1e-3
"""Alpha below which nothing was rendered: the pixel's labels, depth and confidence are 0."""

LEAST_SHARE_OF_CLASS = np.float32(LEAST_OF_CLASS)

FAINT, LEAST_TOTAL, LEAST_SHARE = np.float32(NOTHING), np.float32(1e-8), np.float32(1e-12)
ZERO, ONE = np.float32(0), np.float32(1)
FROM_LABELS = frozenset({"semantic", "instance", "confidence", "entropy"})
"""The layers that need the Gaussians' labels."""
STEPS, STEPS_OF_DEPTH = np.float32(1024), np.float32(4096)
"""Shares and metres are whole multiples of 1 / these. Finer digits would be noise, which does not compress."""
OVER_HALF = np.float32(0.5 + 1 / 256)
"""Least share of a pixel that the decided class and object cover, so that their mattes show it."""


class Columns(NamedTuple):
    """The meaning of the coverage's channels; ties go to the first. A slot is a channel of an instance. ``of_class``
    int64 [C]: the channel of each class but void; ``class_ids`` int32 [C]; ``is_thing`` bool [C]; ``of_slot`` int64
    [S]: the channel of each slot but spare ones; ``slot_ids`` int32 [S]; ``class_of_slot`` int64 [S]: index among the
    classes, -1 = none; ``one_class``: whether an object has one class throughout; ``needs_object`` bool [C]: whether a
    pixel shows the class only with an object."""

    of_class: NDArray[np.int64]
    class_ids: NDArray[np.int32]
    is_thing: NDArray[np.bool_]
    of_slot: NDArray[np.int64]
    slot_ids: NDArray[np.int32]
    class_of_slot: NDArray[np.int64]
    one_class: bool
    needs_object: NDArray[np.bool_]


class Pixels(NamedTuple):
    """The pixels of a rendering, float32: ``image`` [P, 3], ``alpha`` [P], ``depth`` [P], ``classes`` [P, >= C],
    ``slots`` [P, >= S] (see `Columns`)."""

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    classes: NDArray[np.float32]
    slots: NDArray[np.float32]


class PanopticLayers(NamedTuple):
    """The layers of a baked view, all [H, W]; in kernels one row of pixels. A layer that is not wanted is empty.

    ``combined`` float32 [H, W, 4], linear RGB over black and alpha; ``depth`` float32 planar metres (0 = none);
    ``semantic`` int32 class ids (0 only where nothing was rendered); ``instance`` int32, 0 where the class is stuff;
    ``confidence`` float32, the probability of the shown class; ``entropy`` float32, the normalised entropy of the class
    probabilities: 0 = certain, 1 = all classes equally likely."""

    combined: NDArray[np.float32]
    depth: NDArray[np.float32]
    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]
    confidence: NDArray[np.float32]
    entropy: NDArray[np.float32]


@parallel_kernel
def decide_pixels(worker: int, workers: int, pixels: Any, columns: Any, linear_light: Array, decided: Any) -> None:
    """Decide every ``workers``-th chunk of ``pixels`` (Pixels, with their Columns) into ``decided`` (PanopticLayers).
    ``linear_light`` float32 [N + 1] holds the linear values of the sRGB values 0, 1/N, ... 1."""
    count = len(pixels.alpha)
    has_labels, has_colour = len(decided.semantic) > 0, len(decided.combined) > 0
    for start in range(worker * CHUNK, count, workers * CHUNK):
        end = min(start + CHUNK, count)
        for pixel in range(start, end):
            if len(decided.depth) > 0:
                depth = pixels.depth[pixel] if pixels.alpha[pixel] >= FAINT else ZERO
                decided.depth[pixel] = np.rint(STEPS_OF_DEPTH * depth) / STEPS_OF_DEPTH
            if has_colour:
                combine(pixels, pixel, linear_light, decided.combined)
        if has_labels:
            decide_labels(pixels, columns, start, end, decided)


@device_function
def decide_labels(pixels: Any, columns: Any, start: int, end: int, decided: Any) -> None:
    """Decide class and instance of pixels ``start`` to ``end`` and, if wanted, confidence and normalised entropy; all 0
    if nothing was rendered. A call decides many pixels, as passing so many arrays takes as long as deciding one."""
    has_share, has_entropy = len(decided.confidence) > 0, len(decided.entropy) > 0
    classes = len(columns.of_class)
    for pixel in range(start, end):
        decided.semantic[pixel] = decided.instance[pixel] = 0
        if has_share:
            decided.confidence[pixel] = ZERO
        if has_entropy:
            decided.entropy[pixel] = ZERO
        if pixels.alpha[pixel] < FAINT:
            continue
        coverage = pixels.classes[pixel]
        winner, most, total, weighted = 0, ZERO, ZERO, ZERO
        for number in range(classes):
            value = coverage[columns.of_class[number]]
            total += value
            if value > most:
                winner, most = number, value
            if has_entropy and value > LEAST_SHARE:
                weighted += value * np.log(value)
        total = max(total, LEAST_TOTAL)
        if columns.is_thing[winner]:
            slot = best_slot(pixels.slots[pixel], pixels.alpha[pixel], most, columns, winner)
            if slot < 0 and columns.needs_object[winner]:
                winner, most, slot = owned_class(coverage, pixels.slots[pixel], columns, winner, most)
            if slot >= 0:
                decided.instance[pixel] = columns.slot_ids[slot]
        decided.semantic[pixel] = columns.class_ids[winner]
        if has_share:
            decided.confidence[pixel] = np.rint(STEPS * most / total) / STEPS
        if has_entropy:
            # the sum of -p log p for p = value / total
            entropy = (np.log(total) - weighted / total) / np.float32(np.log(max(classes, 2)))
            decided.entropy[pixel] = np.rint(STEPS * max(entropy, ZERO)) / STEPS


@device_function
def owned_class(coverage: Array, slots: Array, columns: Any, winner: int, most: Any) -> Any:
    """Return a class's index, its coverage, and the slot of its object at the pixel (-1 for stuff). It is the class
    with the largest coverage among stuff and things that have an object at the pixel. If none has coverage, return
    ``winner``, ``most`` and -1."""
    best, largest, shown = winner, ZERO, -1
    for number in range(len(columns.of_class)):
        value, slot = coverage[columns.of_class[number]], -1
        if value <= largest:
            continue
        if columns.is_thing[number]:
            least = LEAST_SHARE_OF_CLASS * value
            slot = object_of_class(slots, columns.of_slot, columns.class_of_slot, number, least)
        if slot >= 0 or not columns.is_thing[number]:
            best, largest, shown = number, value, slot
    return best, largest if largest > ZERO else most, shown


@device_function
def best_slot(coverage: Array, alpha: Any, of_class: Any, columns: Any, winner: int) -> int:
    """Return the slot that a pixel of the class with index ``winner`` shows (the first if several tie), -1 for no
    object. ``coverage`` is that of all slots, ``of_class`` that of the class. If objects have one class throughout,
    ``object_of_class`` decides. Otherwise the slot with the largest coverage wins, unless "no object" has more."""
    best, most, instances = -1, ZERO, ZERO
    if columns.one_class:
        least = LEAST_SHARE_OF_CLASS * of_class
        return object_of_class(coverage, columns.of_slot, columns.class_of_slot, winner, least)
    for slot in range(len(columns.of_slot)):
        weight = coverage[columns.of_slot[slot]]
        instances += weight
        if weight > most:
            best, most = slot, weight
    return best if most > alpha - instances else -1  # the rest of alpha is no object


@parallel_kernel
def align_pixels(worker: int, workers: int, pixels: Any, columns: Any, decided: Any, best: Array, owned: Array) -> None:
    """Make ``pixels.classes`` and ``pixels.slots`` agree with ``decided`` in every ``workers``-th chunk of pixels.
    ``best`` int64 and ``owned`` float32 [workers, C] are scratch."""
    for start in range(worker * CHUNK, len(pixels.alpha), workers * CHUNK):
        for pixel in range(start, min(start + CHUNK, len(pixels.alpha))):
            if columns.one_class:
                give_to_owners(pixels, columns, pixel, best[worker], owned[worker])
            for number in range(len(columns.of_class)):
                if columns.class_ids[number] == decided.semantic[pixel]:
                    raise_over_half(pixels.classes[pixel], columns.of_class, number, pixels.alpha[pixel])
            for slot in range(len(columns.of_slot)):
                if columns.slot_ids[slot] == decided.instance[pixel]:
                    raise_over_half(pixels.slots[pixel], columns.of_slot, slot, pixels.alpha[pixel])


@device_function
def give_to_owners(pixels: Any, columns: Any, pixel: int, largest: Array, total: Array) -> None:
    """Give the coverage of a class that belongs to no object to the pixel's largest object of that class. ``largest``
    and ``total`` [C] are scratch: each class's largest slot, and the coverage of all its slots."""
    coverage, by_class = pixels.slots[pixel], pixels.classes[pixel]
    for number in range(len(columns.of_class)):
        largest[number], total[number] = -1, ZERO
    for slot in range(len(columns.of_slot)):
        number, value = columns.class_of_slot[slot], coverage[columns.of_slot[slot]]
        if number >= 0:
            total[number] += value
            if value > ZERO and (largest[number] < 0 or value > coverage[columns.of_slot[largest[number]]]):
                largest[number] = slot
    for number in range(len(columns.of_class)):
        if largest[number] >= 0:
            column, shown = columns.of_slot[largest[number]], by_class[columns.of_class[number]]
            if coverage[column] > LEAST_SHARE_OF_CLASS * shown:
                coverage[column] += max(shown - total[number], ZERO)


@device_function
def raise_over_half(coverage: Array, columns: Array, winner: int, alpha: Any) -> None:
    """Raise the winner's coverage to more than half of a pixel, at the expense of all other columns."""
    own = coverage[columns[winner]]
    wanted = min(OVER_HALF, alpha)
    if own < wanted:
        for number in range(len(columns)):
            coverage[columns[number]] *= (alpha - wanted) / (alpha - own)
        coverage[columns[winner]] = wanted


@device_function
def combine(pixels: Any, pixel: int, linear_light: Array, combined: Array) -> None:
    """Write a pixel's linear colour, interpolated in the table ``linear_light``, and its alpha to ``combined``."""
    steps = len(linear_light) - 1
    for channel in range(3):
        value = min(max(pixels.image[pixel, channel], ZERO), ONE) * np.float32(steps)
        low = min(int(value), steps - 1)  # 1 itself belongs to the last step
        part = value - np.float32(low)
        combined[pixel, channel] = linear_light[low] + part * (linear_light[low + 1] - linear_light[low])
    combined[pixel, 3] = min(max(pixels.alpha[pixel], ZERO), ONE)


LINEAR_STEPS = 4096
"""Steps of the encoded values in the table of linear light. Interpolation between them is exact to 1e-7."""


def decide(
    rendering: PanopticRendering,
    classes: ClassTable,
    instance_classes: Mapping[int, int] | None = None,
    wanted: Collection[str] = (),
    unowned: Collection[int] = (),
) -> PanopticLayers:
    """Decide what every pixel of a rendering shows. ``wanted``: the layers to make (none: all); the others are empty.
    ``unowned`` are thing classes that show also without an object.

    The class is the one with the largest coverage (never void; ties go to the lower id). Its probability is its share
    of the classes' coverage. A pixel of a thing class shows the instance with the largest coverage, unless "no object"
    has more. With ``instance_classes`` (instance id to class id) an object has one class throughout. Its coverage is
    then part of its class's (see ``scene_labels``), and a pixel shows only an instance of its class with LEAST_OF_CLASS
    of that class's coverage. A thing's class that no such instance owns is left out, unless it is ``unowned`` or there
    is nothing else: such pixels are specks, as what is larger became an object (``with_unowned``)."""
    columns, made = _columns(rendering, classes, instance_classes or {}, unowned), {}
    needed = {*(wanted or PanopticLayers._fields)}
    if not needed.isdisjoint(FROM_LABELS):
        needed |= {"semantic", "instance"}
        if not len(columns.of_class):
            raise ValueError("the rendering has no classes")
    for name in PanopticLayers._fields:
        shape = rendering.alpha.shape if name in needed else (0, 0)
        dtype = np.int32 if name in ("semantic", "instance") else np.float32
        made[name] = memory.empty((*shape, 4) if name == "combined" else shape, dtype)
    layers = PanopticLayers(**made)
    parallel_for(worker_count(), decide_pixels, _pixels(rendering), columns, _linear_light(), _flat(layers))
    return layers


def align_mattes(
    rendering: PanopticRendering,
    classes: ClassTable,
    instance_classes: Mapping[int, int] | None,
    decided: PanopticLayers,
) -> None:
    """Change the coverages of a rendering so that its mattes agree with what was ``decided``.

    If an object has one class, it shows in the decided layers with only LEAST_OF_CLASS of its class's coverage. So its
    matte gets all coverage of its class that no other object has. Where three or more share a pixel, the decided class
    and object may cover less than half of it: they are raised to just over half. Edges stay soft."""
    columns, workers = _columns(rendering, classes, instance_classes or {}), worker_count()
    best, owned = (np.empty((workers, len(columns.of_class)), dtype) for dtype in (np.int64, np.float32))
    parallel_for(workers, align_pixels, _pixels(rendering), columns, _flat(decided), best, owned)


def _flat(layers: PanopticLayers) -> PanopticLayers:
    """Return the layers as views of the same memory, with one row per pixel."""
    rows: list[Any] = [layer.reshape(-1) for layer in layers[1:]]
    return PanopticLayers(layers.combined.reshape(-1, 4), *rows)


def _pixels(rendering: PanopticRendering) -> Pixels:
    """Return the pixels of a rendering; the coverages share its memory."""
    image, alpha, depth = (
        np.ascontiguousarray(each, np.float32) for each in (rendering.image, rendering.alpha, rendering.depth)
    )
    covered = (rendering.class_coverage, rendering.instance_coverage)
    by_class, by_slot = (each.reshape(alpha.size, each.shape[-1]) for each in covered)
    return Pixels(image.reshape(-1, 3), alpha.reshape(-1), depth.reshape(-1), by_class, by_slot)


def _columns(
    rendering: PanopticRendering,
    classes: ClassTable,
    instance_classes: Mapping[int, int],
    unowned: Collection[int] = (),
) -> Columns:
    """Return which channels of a rendering stand for which classes and instances, by ascending id."""
    of_class, of_slot = _by_id(rendering.class_ids), _by_id(rendering.instance_ids)
    class_ids = [rendering.class_ids[column] for column in of_class]
    slot_ids = [rendering.instance_ids[column] for column in of_slot]
    index_of = {class_id: number for number, class_id in enumerate(class_ids)}
    return Columns(
        of_class=np.array(of_class, np.int64),
        class_ids=np.array(class_ids, np.int32),
        is_thing=np.isin(class_ids, sorted(classes.thing_ids)),
        of_slot=np.array(of_slot, np.int64),
        slot_ids=np.array(slot_ids, np.int32),
        class_of_slot=np.array([index_of.get(instance_classes.get(one, VOID), -1) for one in slot_ids], np.int64),
        one_class=bool(instance_classes),
        needs_object=np.isin(class_ids, sorted(classes.thing_ids - {*unowned})) & bool(instance_classes),
    )


def _by_id(ids: Sequence[int]) -> list[int]:
    """Return the indices of all ids but 0, in the order of the ids."""
    return sorted((index for index, one in enumerate(ids) if one), key=lambda index: ids[index])


def linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """Decode sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1), float32 of the same shape."""
    values = np.clip(encoded, 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


@cache
def _linear_light() -> NDArray[np.float32]:
    """Return the linear values of LINEAR_STEPS + 1 sRGB values that are evenly spaced from 0 to 1, float32 [n]."""
    return linear(np.linspace(0.0, 1.0, LINEAR_STEPS + 1))


def encoded(linear_values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Encode linear values [...] as sRGB, float32 [...]: the inverse of ``linear``."""
    values = np.clip(linear_values, 0.0, 1.0)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055).astype(np.float32)
