"""From soft coverage to layers: which class and which instance a pixel shows, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.rendering import PanopticRendering
from ..scene import VOID, ClassTable

NOTHING = 1e-3
"""Below this alpha nothing was rendered: the pixel's labels, depth and confidence are 0."""


@dataclass(frozen=True, eq=False)
class PanopticLayers:
    """A view as it is baked, all [H, W].

    ``combined`` float32 [H, W, 4], linear RGB over black and alpha; ``depth`` float32 planar metres (0 =
    none); ``semantic`` int32 class ids (0 only where nothing was rendered); ``instance`` int32, 0 where the
    class is stuff; ``confidence`` float32, the probability of the shown class; ``entropy`` float32 of the
    class probabilities, over the logarithm of their number: 0 sure, 1 no idea.
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

    The class is the one of largest coverage (void never, ties to the lower id), its probability the share of
    the classes' coverage. A pixel of a thing class shows the instance of largest coverage (spare slots, id 0,
    never). With ``instance_classes`` (instance id to class id) an object is of one class throughout, since
    views have voted on objects and pixels have not: such a pixel shows the instance whose coverage times the
    probability of its class is largest, and takes that class. So where no instance was found, an instance
    that no one believes in there cannot impose its class.
    """
    probabilities, class_ids = class_probabilities(rendering)
    rendered = rendering.alpha >= NOTHING
    column = probabilities.argmax(axis=-1)
    semantic = class_ids[column]
    weights = rendering.instance_coverage
    column_of = {int(class_id): c for c, class_id in enumerate(class_ids)}
    if instance_classes:
        columns = [column_of.get(instance_classes.get(one, VOID), -1) for one in rendering.instance_ids]
        weights = weights * np.where(np.array(columns) >= 0, probabilities[..., columns], 0)
    instance = np.where(np.isin(semantic, sorted(classes.thing_ids)), _best_instance(rendering, weights), 0)
    if instance_classes:
        semantic, column = _class_of_instance(semantic, column, instance, class_ids, instance_classes)
        instance = np.where(np.isin(semantic, sorted(classes.thing_ids)), instance, 0)
    confidence = np.take_along_axis(probabilities, column[..., None], axis=-1)[..., 0]
    entropy = -(probabilities * np.log(np.maximum(probabilities, 1e-12))).sum(axis=-1)
    return PanopticLayers(
        combined=np.dstack([linear(rendering.image), np.clip(rendering.alpha, 0, 1)]).astype(np.float32),
        depth=np.where(rendered, rendering.depth, 0).astype(np.float32),
        semantic=np.where(rendered, semantic, VOID).astype(np.int32),
        instance=np.where(rendered, instance, 0).astype(np.int32),
        confidence=np.where(rendered, confidence, 0).astype(np.float32),
        entropy=np.where(rendered, entropy / np.log(max(len(class_ids), 2)), 0).astype(np.float32),
    )


def class_probabilities(rendering: PanopticRendering) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Probabilities float32 [H, W, C'] of the classes but void, and their ids int32 [C'], ascending.

    Raises ValueError when the rendering has no class at all.
    """
    ids = np.array(rendering.class_ids, np.int32)
    columns = [c for c in np.argsort(ids, kind="stable").tolist() if ids[c] != VOID]
    if not columns:
        raise ValueError("the rendering has no classes")
    coverage = rendering.class_coverage[..., columns]
    total = coverage.sum(axis=-1, keepdims=True)
    return (coverage / np.maximum(total, 1e-8)).astype(np.float32), ids[columns]


def linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """sRGB-encoded values in [0, 1] decoded to linear light (IEC 61966-2-1), float32 of the same shape."""
    values = np.clip(encoded, 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encoded(linear_values: NDArray[np.floating]) -> NDArray[np.float32]:
    """The inverse of ``linear``."""
    values = np.clip(linear_values, 0.0, 1.0)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055).astype(np.float32)


def _best_instance(rendering: PanopticRendering, weights: NDArray[np.floating]) -> NDArray[np.int32]:
    """Instance id of the largest weight [H, W, S], int32 [H, W]; 0 where all are 0. Ties: lower id."""
    ids = np.array(rendering.instance_ids, np.int32)
    columns = [c for c in np.argsort(ids, kind="stable").tolist() if ids[c] != 0]
    if not columns:
        return np.zeros(rendering.alpha.shape, np.int32)
    weights = weights[..., columns]
    return np.where(weights.max(axis=-1) > 0, ids[columns][weights.argmax(axis=-1)], 0).astype(np.int32)


def _class_of_instance(
    semantic: NDArray[np.int32],
    column: NDArray[np.int64],
    instance: NDArray[np.int32],
    class_ids: NDArray[np.int32],
    instance_classes: Mapping[int, int],
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Class ids and their columns after pixels with an instance have taken its class, if the model has it."""
    columns = {int(class_id): c for c, class_id in enumerate(class_ids)}
    table = np.full(max(int(instance.max(initial=0)), 0) + 1, -1)
    for instance_id, class_id in instance_classes.items():
        if 0 < instance_id < len(table) and class_id in columns:
            table[instance_id] = columns[class_id]
    column = np.where(table[instance] >= 0, table[instance], column)
    return class_ids[column], column
