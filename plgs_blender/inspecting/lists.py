"""Filling the lists of a lift from its result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ...engine.scene import VOID, ClassTable
from ..colour import UNKNOWN
from ..results import Instance, LiftResult, Mask
from .colouring import apply_colours
from .labels import let_boxes_show_names
from .records import NO_AGREEMENT, NO_COST, registered
from .visibility import apply_visibility


def fill_lists(root: bpy.types.Collection, result: LiftResult) -> None:
    """Let the lift's collection list the instances, with their masks, and the classes. All of them are shown then."""
    with registered(), apply_colours.at_once(root), apply_visibility.at_once(root):
        lists = root.plgs
        lists.instances.clear()
        lists.classes.clear()
        lists.instance_index = lists.class_index = -1
        lists.isolated = 0
        for instance in result.instances:
            _fill_instance(lists.instances.add(), instance, result.classes)
        points = result.points
        ids, rows, counts = np.unique(points.class_id, return_inverse=True, return_counts=True)
        scores = np.bincount(rows, np.nan_to_num(points.confidence), len(ids)) / np.maximum(counts, 1)
        for class_id, count, score in zip(ids.tolist(), counts.tolist(), scores.tolist(), strict=True):
            _fill_class(lists.classes.add(), class_id, count, score, result.classes)
        let_boxes_show_names(root, not lists.show_labels)


def best_view(masks: Sequence[Mask]) -> int:
    """Which of an instance's masks sees most of it: the one with the largest share of its picture, where a mask that
    the picture's edge cuts off counts half; the first of equals, -1 when shares are not known.
    """
    worth = [mask.share * (0.5 if _is_cut_off(mask) else 1.0) for mask in masks]
    return int(np.argmax(worth)) if worth and max(worth) > 0.0 else -1


def reason(mask: Mask) -> str:
    """Why a mask was matched to its instance, in the few words that fit into a list."""
    if mask.agreement is not None:
        return f"{100 * mask.agreement:.0f} % agreement"
    if mask.cost is not None:
        return f"cost {mask.cost:.2f}"
    return "founded it" if mask.share > 0.0 else ""


def _is_cut_off(mask: Mask) -> bool:
    left, top, right, bottom = mask.rectangle
    return left <= 0.0 or top <= 0.0 or right >= 1.0 or bottom >= 1.0


def _fill_instance(row: Any, instance: Instance, classes: ClassTable) -> None:
    row.name, row.instance_id = instance.name, instance.id
    row.class_id, row.class_name = instance.class_id, instance.class_name
    row.colour = [channel / 255.0 for channel in instance.colour]
    row.points, row.views, row.score = instance.points, instance.views, instance.score
    row.best_mask = best_view(instance.masks)
    for mask in instance.masks:
        each = row.masks.add()
        each.frame, each.segment, each.class_id = mask.frame, mask.segment_id, mask.class_id
        each.class_name = classes[mask.class_id].name if mask.class_id in classes else "unknown"
        each.score, each.pixels, each.share = mask.score, mask.pixels, mask.share
        each.cost = NO_COST if mask.cost is None else mask.cost
        each.agreement = NO_AGREEMENT if mask.agreement is None else mask.agreement
        each.rectangle, each.reason = mask.rectangle, reason(mask)


def _fill_class(row: Any, class_id: int, points: int, score: float, classes: ClassTable) -> None:
    known = class_id != VOID and class_id in classes
    row.class_id, row.points, row.score = class_id, points, score
    row.name = classes[class_id].name if known else "unknown"
    row.is_thing = known and classes[class_id].is_thing
    row.colour = [channel / 255.0 for channel in (classes[class_id].colour if known else UNKNOWN)]
