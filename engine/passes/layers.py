"""From soft coverage to layers: which class and which instance a pixel shows, and with what probability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..machine import memory
from ..machine.threads import parallel_for, worker_count
from ..model.rendering import PanopticRendering
from ..scene import VOID, ClassTable
from .deciding import Columns, Decided, Pixels, decide_pixels, tell_decision

LINEAR_STEPS = 4096
"""Steps of the encoded values in the table of linear light. Interpolation between them is exact to 1e-7."""


@dataclass(frozen=True, eq=False)
class PanopticLayers:
    """The layers of a baked view, all [H, W].

    ``combined`` float32 [H, W, 4], linear RGB over black and alpha; ``depth`` float32 planar metres (0 = none);
    ``semantic`` int32 class ids (0 only where nothing was rendered); ``instance`` int32, 0 where the class is stuff;
    ``confidence`` float32, the probability of the shown class; ``entropy`` float32, the normalised entropy of the class
    probabilities: 0 = certain, 1 = all classes equally likely.
    """

    combined: NDArray[np.float32]
    depth: NDArray[np.float32]
    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]
    confidence: NDArray[np.float32]
    entropy: NDArray[np.float32]


def decide(
    rendering: PanopticRendering,
    classes: ClassTable,
    instance_classes: Mapping[int, int] | None = None,
) -> PanopticLayers:
    """Decide every pixel of a rendering.

    The class is the one with the largest coverage (never void; ties go to the lower id). Its probability is its share
    of the classes' coverage. A pixel of a thing class shows the instance with the largest coverage, unless "no object"
    has more. With ``instance_classes`` (instance id to class id) an object has one class throughout. Its coverage is
    then part of its class's (see ``scene_labels``), and a pixel shows only an instance of its class with LEAST_OF_CLASS
    of that class's coverage. So what no object owns shows its own class and no instance.
    """
    height, width = rendering.alpha.shape
    columns = _columns(rendering, classes, instance_classes or {})
    layers = PanopticLayers(
        combined=memory.empty((height, width, 4), np.float32),
        depth=memory.empty((height, width), np.float32),
        semantic=memory.empty((height, width), np.int32),
        instance=memory.empty((height, width), np.int32),
        confidence=memory.empty((height, width), np.float32),
        entropy=memory.empty((height, width), np.float32),
    )
    parallel_for(worker_count(), decide_pixels, _pixels(rendering), columns, _linear_light(), _flat(layers))
    return layers


def tell_in_coverage(
    rendering: PanopticRendering,
    classes: ClassTable,
    instance_classes: Mapping[int, int] | None,
    decided: PanopticLayers,
) -> None:
    """Change the coverages of a rendering so that its mattes agree with what was ``decided``.

    A pixel of the class chair shows the chair that has LEAST_OF_CLASS of it. So if an object has one class, that
    chair gets all of the class's coverage that no other chair has. Where three or more share a pixel, the decided
    class and object may cover less than half of it. They get just over half. Edges stay soft.
    """
    columns, workers = _columns(rendering, classes, instance_classes or {}), worker_count()
    best, owned = (np.empty((workers, len(columns.of_class)), dtype) for dtype in (np.int64, np.float32))
    parallel_for(workers, tell_decision, _pixels(rendering), columns, _flat(decided), best, owned)


def _flat(layers: PanopticLayers) -> Decided:
    """The layers as views of the same memory, one row per pixel."""
    return Decided(
        combined=layers.combined.reshape(-1, 4),
        depth=layers.depth.reshape(-1),
        semantic=layers.semantic.reshape(-1),
        instance=layers.instance.reshape(-1),
        confidence=layers.confidence.reshape(-1),
        entropy=layers.entropy.reshape(-1),
    )


def _pixels(rendering: PanopticRendering) -> Pixels:
    """The pixels of a rendering; the coverages share its memory."""
    image, alpha, depth = (
        np.ascontiguousarray(each, np.float32) for each in (rendering.image, rendering.alpha, rendering.depth)
    )
    covered = (rendering.class_coverage, rendering.instance_coverage)
    by_class, by_slot = (each.reshape(alpha.size, each.shape[-1]) for each in covered)
    return Pixels(image.reshape(-1, 3), alpha.reshape(-1), depth.reshape(-1), by_class, by_slot)


def _columns(rendering: PanopticRendering, classes: ClassTable, instance_classes: Mapping[int, int]) -> Columns:
    """The channels to decide between, by ascending id. Raises ValueError if the rendering has no class."""
    of_class, of_slot = _by_id(rendering.class_ids), _by_id(rendering.instance_ids)
    if not of_class:
        raise ValueError("the rendering has no classes")
    class_ids = [rendering.class_ids[column] for column in of_class]
    slot_ids = [rendering.instance_ids[column] for column in of_slot]
    place = {class_id: number for number, class_id in enumerate(class_ids)}
    return Columns(
        of_class=np.array(of_class, np.int64),
        class_ids=np.array(class_ids, np.int32),
        is_thing=np.isin(class_ids, sorted(classes.thing_ids)),
        of_slot=np.array(of_slot, np.int64),
        slot_ids=np.array(slot_ids, np.int32),
        class_of_slot=np.array([place.get(instance_classes.get(one, VOID), -1) for one in slot_ids], np.int64),
        one_class=bool(instance_classes),
    )


def _by_id(ids: Sequence[int]) -> list[int]:
    """The places of all ids but 0, by ascending id."""
    return sorted((place for place, one in enumerate(ids) if one), key=lambda place: ids[place])


def linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """sRGB-encoded values in [0, 1] decoded to linear light (IEC 61966-2-1), float32 of the same shape."""
    values = np.clip(encoded, 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


@cache
def _linear_light() -> NDArray[np.float32]:
    """The linear values of LINEAR_STEPS + 1 encoded ones, evenly spaced from 0 to 1."""
    return linear(np.linspace(0.0, 1.0, LINEAR_STEPS + 1))


def encoded(linear_values: NDArray[np.floating]) -> NDArray[np.float32]:
    """The inverse of ``linear``."""
    values = np.clip(linear_values, 0.0, 1.0)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055).astype(np.float32)
