"""Algorithm 1: one global set of instances from the inconsistent instance masks of all views.

Paper, section "Consistent Instance Mask Generation". Where the text leaves a choice it is an option here; the
defaults are the ones that held up best in measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ..scene import View
from .oriented_box import OrientedBox, fit_box, intersection_volume
from .segments import LocalInstance, SegmentOptions, local_instances, thin

Progress = Callable[[int, int], None]
"""Called with (done, total) after each view; may raise to stop."""


@dataclass(frozen=True)
class MatchingOptions:
    """``tau_new``: a segment whose least cost is above it is a new instance. ``rule``: "hybrid" takes the
    Hungarian partner if its cost is at most tau, else the best global instance if that is, else a new one;
    "literal" is the text of Algorithm 1. ``cost``: the terms of O; the paper's table of ablations has each alone.
    """

    tau_new: float = -0.1
    rule: Literal["hybrid", "literal"] = "hybrid"
    cost: Literal["IoU+IoM", "IoU", "IoM"] = "IoU+IoM"

    def __post_init__(self) -> None:
        _one_of("rule", self.rule, ("hybrid", "literal"))
        _one_of("cost", self.cost, ("IoU+IoM", "IoU", "IoM"))


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")


@dataclass(frozen=True)
class Evidence:
    """One segment that belongs to an instance; ``pixels``: how many it has with depth. ``cost`` O of the match, None
    for the segment that founded it. ``agreement`` where the views joined it instead: ``MemberMask.agreement``.
    """

    frame: str
    segment_id: int
    class_id: int
    score: float
    pixels: int
    cost: float | None
    agreement: float | None = None


@dataclass(frozen=True, eq=False)
class GlobalInstance:
    """{P_g, B_g}, what it is and where it comes from: ``points`` float64 [n, 3] metres, thinned."""

    id: int
    points: NDArray[np.float64]
    box: OrientedBox
    evidence: tuple[Evidence, ...]
    class_id: int

    @property
    def views(self) -> int:
        return len({item.frame for item in self.evidence})

    @property
    def score(self) -> float:
        """Mean score of the segments."""
        return sum(item.score for item in self.evidence) / len(self.evidence)

    @property
    def pixels(self) -> int:
        return sum(item.pixels for item in self.evidence)


def pair_cost(local: OrientedBox, known: OrientedBox, terms: str = "IoU+IoM") -> float:
    """O = -IoU - IoM, between -1.5 and 0, or one of the two alone. As in the paper's formula, the union is the sum of
    the volumes."""
    inter = intersection_volume(local, known)
    if inter <= 0:
        return 0.0
    iou, iom = inter / (local.volume + known.volume), inter / min(local.volume, known.volume)
    return {"IoU+IoM": -iou - iom, "IoU": -iou, "IoM": -iom}[terms]


def class_by_views(evidence: Sequence[Evidence]) -> int:
    """The class most voted for: in each view the segments share the square root of their pixels; ties: lower
    id.

    So a near view, which sees more, counts for more, but cannot outvote the others by its mass of pixels.
    """
    seen: dict[str, int] = {}
    for item in evidence:
        seen[item.frame] = seen.get(item.frame, 0) + item.pixels
    votes: dict[int, float] = {}
    for item in evidence:
        votes[item.class_id] = votes.get(item.class_id, 0.0) + item.pixels / math.sqrt(max(seen[item.frame], 1))
    return min(votes, key=lambda class_id: (-round(votes[class_id], 9), class_id))


def match_views(
    views: Sequence[View],
    class_ids: frozenset[int],
    segments: SegmentOptions,
    options: MatchingOptions,
    progress: Progress | None = None,
) -> list[GlobalInstance]:
    """Algorithm 1 over the views in their order: I_global, ids 1.. in order of first sight."""
    known: list[GlobalInstance] = []
    for done, view in enumerate(views, start=1):
        known = update_instances(known, local_instances(view, class_ids, segments), segments.voxel_size, options)
        if progress:
            progress(done, len(views))
    return known


def update_instances(
    known: list[GlobalInstance], local: list[LocalInstance], voxel_size: float, options: MatchingOptions
) -> list[GlobalInstance]:
    """I'_global after one view; ``known`` is left as it is."""
    updated = list(known)
    cost = np.array([[pair_cost(item.box, g.box, options.cost) for g in known] for item in local])
    for row, target in enumerate(_targets(cost.reshape(len(local), len(known)), options)):
        item = local[row]
        evidence = Evidence(item.frame, item.segment.id, item.segment.class_id, item.segment.score, item.pixels,
                            None if target is None else float(cost[row, target]))  # fmt: skip
        if target is None:
            updated.append(GlobalInstance(len(updated) + 1, item.points, item.box, (evidence,), evidence.class_id))
        else:
            updated[target] = _joined(updated[target], item.points, (evidence,), voxel_size)
    return updated


def _targets(cost: NDArray[np.float64], options: MatchingOptions) -> list[int | None]:
    """Which global instance each local one joins, None = a new one."""
    local, known = cost.shape
    if not known:
        return [None] * local
    partner = dict(zip(*linear_sum_assignment(cost), strict=True))
    targets: list[int | None] = []
    for row in range(local):
        best = int(cost[row].argmin())
        assigned = int(partner.get(row, best))
        if cost[row, best] > options.tau_new:
            targets.append(None)
        elif options.rule == "literal" or cost[row, assigned] <= options.tau_new:
            targets.append(assigned)
        else:
            targets.append(best)
    return targets


def _joined(
    instance: GlobalInstance, points: NDArray[np.float64], evidence: tuple[Evidence, ...], voxel_size: float
) -> GlobalInstance:
    together = thin(np.concatenate([instance.points, points]), voxel_size)
    box, both = fit_box(together, voxel_size), instance.evidence + evidence
    return replace(instance, points=together, box=box, evidence=both, class_id=class_by_views(both))


def limit_instances(
    instances: Sequence[GlobalInstance], instance_of_point: NDArray[np.int32], most: int
) -> tuple[list[GlobalInstance], NDArray[np.int32], int]:
    """Keep the ``most`` instances with the most pixels, renumbered 1.. in their order.

    Gives them, the points' instances int32 [N] in the new numbers (0 = none or dropped), and how many were
    dropped, of which the user should be told.
    """
    largest = sorted(instances, key=lambda item: (-item.pixels, item.id))[:most]
    kept = sorted(largest, key=lambda item: item.id)
    number = np.zeros(max([int(instance_of_point.max(initial=0)), *(item.id for item in instances)], default=0) + 1)
    for new, item in enumerate(kept, start=1):
        number[item.id] = new
    renumbered = [replace(item, id=new) for new, item in enumerate(kept, start=1)]
    return renumbered, number[instance_of_point].astype(np.int32), len(instances) - len(kept)
