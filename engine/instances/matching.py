"""Algorithm 1: makes one global set of instances from the inconsistent instance masks of all views. See the paper's
section "Consistent Instance Mask Generation". Where its text leaves a choice, there is an option. The defaults are
those that measured best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ..presets.preset import Matching
from ..scene import Progress, View
from .records import ObjectMask, OrientedBox, SceneObject, fit_box, intersection_volume
from .segments import SegmentOptions, local_instances, thin


def pair_cost(local: OrientedBox, known: OrientedBox, terms: str = "IoU+IoM") -> float:
    """Return the cost O = -IoU - IoM of matching two boxes, -1.5 to 0, or one of its ``terms``. As in the paper's
    formula, the union is the sum of both volumes."""
    inter = intersection_volume(local, known)
    if inter <= 0:
        return 0.0
    iou, iom = inter / (local.volume + known.volume), inter / min(local.volume, known.volume)
    return {"IoU+IoM": -iou - iom, "IoU": -iou, "IoM": -iom}[terms]


def class_by_views(masks: Sequence[ObjectMask]) -> int:
    """Return the class id with the most votes of the masks. A view has as many votes as the square root of the number
    of its masks' pixels, shared by pixels, so that a near view does not outvote all others. Ties go to the lower id."""
    seen: dict[str, int] = {}
    for mask in masks:
        seen[mask.frame] = seen.get(mask.frame, 0) + mask.pixels
    votes: dict[int, float] = {}
    for mask in masks:
        kind = mask.segment.class_id
        votes[kind] = votes.get(kind, 0.0) + mask.pixels / math.sqrt(max(seen[mask.frame], 1))
    return min(votes, key=lambda class_id: (-round(votes[class_id], 9), class_id))  # rounded: ties by float error count


def match_views(
    views: Sequence[View],
    class_ids: frozenset[int],
    segments: SegmentOptions,
    options: Matching,
    progress: Progress | None = None,
) -> list[SceneObject]:
    """Run Algorithm 1 over the views in order, on segments of ``class_ids`` taken by ``segments``. Return the global
    instances, with ids from 1 in order of appearance."""
    known: list[SceneObject] = []
    for done, view in enumerate(views, start=1):
        known = update_instances(known, local_instances(view, class_ids, segments), segments.voxel_size, options)
        if progress:
            progress(done, len(views))
    return known


def update_instances(
    known: list[SceneObject], local: list[SceneObject], voxel_size: float, options: Matching
) -> list[SceneObject]:
    """Match a view's masks, ``local``, to the ``known`` instances, whose points are thinned to ``voxel_size`` metres.
    Return a new list of all instances."""
    updated = list(known)
    cost = np.array([[pair_cost(item.box, g.box, options.cost) for g in known] for item in local])
    for row, target in enumerate(_targets(cost.reshape(len(local), len(known)), options)):  # empty lists have no axis
        if target is None:
            updated.append(replace(local[row], id=len(updated) + 1))
        else:
            one, other = updated[target], local[row]
            points = thin(np.concatenate([one.points, other.points]), voxel_size)
            masks = (*one.masks, *(replace(mask, cost=float(cost[row, target])) for mask in other.masks))
            box = fit_box(points, voxel_size)
            updated[target] = replace(one, points=points, box=box, masks=masks, class_id=class_by_views(masks))
    return updated


def _targets(cost: NDArray[np.float64], options: Matching) -> list[int | None]:
    """Return the index of the global instance that each local instance joins, None = a new one; ``cost`` [L, G]."""
    local, known = cost.shape
    if not known:
        return [None] * local
    partner = dict(zip(*linear_sum_assignment(cost), strict=True))
    targets: list[int | None] = []
    for row in range(local):
        best = int(cost[row].argmin())
        assigned = int(partner.get(row, best))  # where there are more local ones than known, some have no partner
        if cost[row, best] > options.tau_new:
            targets.append(None)
        elif options.rule == "literal" or cost[row, assigned] <= options.tau_new:
            targets.append(assigned)
        else:
            targets.append(best)
    return targets


def limit_instances(
    instances: Sequence[SceneObject], instance_of_point: NDArray[np.int32], most: int
) -> tuple[list[SceneObject], NDArray[np.int32], int]:
    """Keep the ``most`` instances with the most pixels, renumbered from 1. Return them, each point's new instance int32
    [N] (0 = none, or left out), and how many instances were left out. The caller tells the user."""
    largest = sorted(instances, key=lambda item: (-item.pixels, item.id))[:most]
    kept = sorted(largest, key=lambda item: item.id)
    number = np.zeros(max([int(instance_of_point.max(initial=0)), *(item.id for item in instances)], default=0) + 1)
    for new, item in enumerate(kept, start=1):
        number[item.id] = new
    renumbered = [replace(item, id=new) for new, item in enumerate(kept, start=1)]
    return renumbered, number[instance_of_point].astype(np.int32), len(instances) - len(kept)
