"""What may be wrong with a lift: its most doubtful objects, each with a reason and a suggested edit; the class that the
masks give each part of a split object; and how uncertain the points are that each camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import LiftFolder
from ..known_scene import read_known
from ..posed import Camera
from ..posed.layout import plural
from ..result_files import Instance, SemanticPoints
from .making import parts_of
from .replay import INNER, Replay, overlap
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
    """A suggestion about the object ``instance``. ``doubt`` is in (0, 1], ``reason`` a text. ``answer`` is the edit
    that would correct it: reclass (to ``class_id``), split, split by views, delete, or merge (with ``other``).
    ``frame`` shows it best, "" without a mask."""

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
    """The ``open`` proposals about a lift, worst first. ``all`` is the number of its objects, and ``looked_at`` how
    many of these a person corrected or accepted."""

    open: tuple[Proposal, ...]
    looked_at: int
    all: int

    @property
    def progress(self) -> str:
        return f"{self.looked_at} of {self.all} corrected or accepted"


def proposals_of(corrected: CorrectedResult) -> Proposals:
    """Return each object's most doubtful proposal, if it has one and no edit refers to the object."""
    known = {one.id for one in corrected.instances}
    edits = [edit for edit in corrected.edits if not edit.undone and edit.uid not in corrected.not_applied]
    looked_at = {mark.id for edit in edits for mark in edit.objects} | {new.id for edit in edits for new in edit.made}
    doubts = [_doubts(corrected, one) for one in corrected.instances if one.id not in looked_at]
    found = [max(each, key=lambda proposal: proposal.doubt) for each in doubts if each]
    worst = sorted(found, key=lambda each: (-each.doubt, each.instance))
    total = len({one.id for one in corrected.made} | looked_at)
    left = len(known - looked_at)
    return Proposals(tuple(worst), total - left, total)


def _doubts(corrected: CorrectedResult, one: Instance) -> list[Proposal]:
    """Return all proposals about the object ``one``, each with its doubt."""
    best = max(one.segments, key=lambda segment: segment.share, default=None)
    frame, found, votes = best.frame if best else "", [], dict[int, float]()
    mine = corrected.points.instance_id == one.id
    xyz, likely = corrected.points.xyz[mine], corrected.points.confidence[mine]

    def propose(
        doubt: float, reason: str, answer: str, *, class_id: int = 0, other: int = 0, seen: str = frame
    ) -> None:
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
        if other.class_id != one.class_id or other.id >= one.id:  # a pair is asked about once
            continue
        # Metres between the boxes along the axis on which they are farthest apart, as if they stood upright.
        apart = np.abs(np.subtract(one.centre, other.centre)) - (np.array(one.size) + np.array(other.size)) / 2
        if (gap := float(apart.max())) < TOUCHING:
            propose(0.5 * (1 - gap / TOUCHING), f"it touches {other.name}", "merge", other=other.id)
    return found


def _frames_apart(one: Instance) -> tuple[list[str], int]:
    """Return the frames whose masks show an object as several segments, the one with the largest second segment first,
    and the number of frames that have a mask of it."""
    sizes: dict[str, list[int]] = {}
    for segment in one.segments:
        sizes.setdefault(segment.frame, []).append(segment.pixels)
    second = {frame: sorted(each)[-2] for frame, each in sizes.items() if len(each) > 1}
    apart = [frame for frame, pixels in second.items() if pixels > 0 and pixels >= LARGE * max(sizes[frame])]
    return sorted(apart, key=lambda frame: (-second[frame], frame)), len(sizes)


FITS = 0.5
"""Least intersection over union with a mask's rectangle at which the mask shows this part and little else."""


def class_of_parts(lift: Path, state: Replay, number: int, part: NDArray[np.integer]) -> dict[int, int]:
    """Return the class that most masks of an object give each part; ``part`` int [n] is the part of each of its points.
    A mask votes for the part whose points fill its rectangle, weighted by its pixels; parts without votes are left out.
    Raises PlgsError if the list of the lift's frames is damaged."""
    if number not in state.objects or not len(part):
        return {}
    folder = LiftFolder.open(lift)
    known = read_known(folder)
    if known is None:
        return {}
    cameras = {frame.name: frame.camera for frame in known.posed_frames(folder.request.scene)}
    xyz, numbers = state.points_of(number), np.unique(part).tolist()
    votes: dict[int, dict[int, float]] = {}
    for segment in state.objects[number].segments:
        camera = cameras.get(segment.frame)
        if camera is None or segment.class_id not in state.classes.thing_ids:
            continue
        rows, pixel, _ = camera.seen(xyz)
        points, shown = pixel / camera.size, part[rows]
        own, box = (points[shown == each] for each in numbers), np.reshape(segment.rectangle, (2, 2))
        fits = [overlap(np.percentile(each, INNER, axis=0), box) if len(each) else 0.0 for each in own]
        if max(fits) >= FITS:
            vote = votes.setdefault(numbers[int(np.argmax(fits))], {})
            vote[segment.class_id] = vote.get(segment.class_id, 0.0) + segment.pixels
    return {each: max(sorted(own), key=lambda kind: own[kind]) for each, own in votes.items()}  # ties: the lower id


_CELLS = 48
"""Cells across the picture. In each, the nearest point hides what lies behind it."""
_BEHIND = 0.15
"""Metres that a point may lie behind the nearest one and still be seen."""


def entropy_of(confidence: NDArray[np.floating]) -> NDArray[np.float64]:
    """The entropy in bits [N] of a class that is right with the probability ``confidence`` [N]: 0 is certain."""
    share = np.clip(confidence.astype(np.float64), 1e-6, 1 - 1e-6)
    return np.asarray(np.where(share < 0.5, 1.0, -share * np.log2(share) - (1 - share) * np.log2(1 - share)))


def entropy_of_views(points: SemanticPoints, cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the mean of `entropy_of` over the points that each camera sees, float64 [V]; 0 if it sees no point."""
    doubt, found = entropy_of(points.confidence), np.zeros(len(cameras))
    for number, camera in enumerate(cameras):
        rows, pixel, depth = camera.seen(points.xyz)
        column, row = (pixel * (_CELLS / camera.width)).astype(np.int64).T
        cell = row * _CELLS + column
        nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)
        np.minimum.at(nearest, cell, depth)
        seen = rows[depth <= nearest[cell] + _BEHIND]
        found[number] = doubt[seen].mean() if len(seen) else 0.0
    return found
