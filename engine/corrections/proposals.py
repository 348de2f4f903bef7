"""What may be wrong with a lift: its objects, the most doubtful first, each with a reason and an answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..posed.layout import plural
from ..result_files import Instance
from .making import parts_of
from .result import CorrectedResult

BY_VIEWS = "split by views"
"""An answer that needs an engine."""
LEAST_DOUBT = 0.15
"""Doubt below which nothing is proposed."""
FEW_VIEWS = 3
"""An object seen in fewer frames may not be a real object."""
CRUMB = 60
"""An object with fewer points may be a crumb."""
APART = 0.2
"""An object may be several things if at least this share of its frames show it as several segments. Masks that are cut
by something in front do so in fewer frames."""
LARGE = 0.15
"""A segment with at least this share of the pixels of the frame's largest one is not a crumb."""
TOUCHING = 0.1
"""Metres between two objects of a class that may be one."""


@dataclass(frozen=True)
class Proposal:
    """``doubt`` in (0, 1]. ``answer`` is the edit that would correct it: reclass (to ``class_id``), split,
    split by views, delete, or merge (with ``other``). ``frame`` shows it best, empty where no mask does."""

    instance: int
    name: str
    doubt: float
    reason: str
    answer: str
    class_id: int = 0
    other: int = 0
    frame: str = ""


@dataclass(frozen=True)
class Proposals:
    """The ``open`` proposals, worst first, and how many of all objects were ``looked_at``: corrected or accepted."""

    open: tuple[Proposal, ...]
    looked_at: int
    all: int

    @property
    def progress(self) -> str:
        return f"{self.looked_at} of {self.all} looked at"


def proposals_of(corrected: CorrectedResult) -> Proposals:
    """At most one proposal per object, the most doubtful; none for objects that an edit refers to."""
    known = {one.id for one in corrected.instances}
    edits = [edit for edit in corrected.edits if not edit.undone and edit.uid not in corrected.told]
    looked_at = {mark.id for edit in edits for mark in edit.objects} | {new.id for edit in edits for new in edit.made}
    doubts = [_doubts(corrected, one) for one in corrected.instances if one.id not in looked_at]
    found = [max(each, key=lambda proposal: proposal.doubt) for each in doubts if each]
    worst = sorted(found, key=lambda each: (-each.doubt, each.instance))
    total = len({one.id for one in corrected.made} | looked_at)
    left = len(known - looked_at)
    return Proposals(tuple(worst), total - left, total)


def _doubts(corrected: CorrectedResult, one: Instance) -> list[Proposal]:
    """Everything that may be wrong with an object."""
    best = max(one.segments, key=lambda segment: segment.share, default=None)
    frame, found, votes = best.frame if best else "", [], dict[int, float]()
    mine = corrected.points.instance_id == one.id
    xyz, likely = corrected.points.xyz[mine], corrected.points.confidence[mine]

    def propose(doubt: float, reason: str, answer: str, class_id: int = 0, other: int = 0, seen: str = frame) -> None:
        if doubt >= LEAST_DOUBT:
            found.append(Proposal(one.id, one.name, min(doubt, 1.0), reason, answer, class_id, other, seen))

    for segment in one.segments:
        votes[segment.class_id] = votes.get(segment.class_id, 0.0) + segment.score
    rivals = {kind: vote for kind, vote in votes.items() if kind != one.class_id and kind in corrected.classes}
    if rivals:
        kind = max(rivals, key=lambda each: rivals[each])
        share = rivals[kind] / max(sum(votes.values()), 1e-9)
        reason = f"{100 * share:.0f} % of its masks say {corrected.classes[kind].name}"
        propose(max(2.0 * share, float(np.sum(1.0 - likely)) / max(len(likely), 1)), reason, "reclass", class_id=kind)
    apart, frames = _frames_apart(one)
    if len(apart) > 1 and len(apart) > APART * frames:
        reason = f"the masks of {len(apart)} of {frames} frames separate it"
        propose(2.0 * len(apart) / frames, reason, BY_VIEWS, seen=apart[0])
    sizes = np.bincount(parts_of(xyz))
    if len(sizes) > 1:
        propose(2.0 * float(1 - sizes[0] / len(xyz)), f"it consists of {len(sizes)} parts that do not touch", "split")
    if one.views < FEW_VIEWS:
        propose(0.6 / max(one.views, 1), f"only {plural(one.views, 'frame shows', 'frames show')} it", "delete")
    if len(xyz) < CRUMB:
        propose(0.7 * (1 - len(xyz) / CRUMB), f"it has only {plural(len(xyz), 'point')}", "delete")
    for other in corrected.instances:
        if other.class_id == one.class_id and other.id < one.id and (gap := _gap(one, other)) < TOUCHING:
            propose(0.5 * (1 - gap / TOUCHING), f"it touches {other.name}", "merge", other=other.id)
    return found


def _frames_apart(one: Instance) -> tuple[list[str], int]:
    """The frames whose masks show an object as several segments, the one with the largest second segment first, and the
    number of frames that have a mask of it."""
    sizes: dict[str, list[int]] = {}
    for segment in one.segments:
        sizes.setdefault(segment.frame, []).append(segment.pixels)
    second = {frame: sorted(each)[-2] for frame, each in sizes.items() if len(each) > 1}
    apart = [frame for frame, pixels in second.items() if pixels > 0 and pixels >= LARGE * max(sizes[frame])]
    return sorted(apart, key=lambda frame: (-second[frame], frame)), len(sizes)


def _gap(one: Instance, other: Instance) -> float:
    """Metres between two boxes along the axis on which they are farthest apart, as if they stood upright."""
    apart = np.abs(np.subtract(one.centre, other.centre)) - (np.array(one.size) + np.array(other.size)) / 2
    return float(apart.max())
