"""Splits an object into parts that the views' masks show as separate things, even if the parts touch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..corrections import CORRECTIONS, Edit, making
from ..corrections.relabelling import nearest
from ..corrections.replay import Replay
from ..errors import ErrorCode, PlgsError
from ..instances.consensus import join
from ..job import LiftFolder
from ..scene import Frame
from ..scene.evidence import resolution_on
from ..scene_of_lift import scene_of_lift

MOST_FRAMES = 80
"""The most frames that are used: those that see most of the object."""
SEEN_WITHIN = 0.05
"""A frame sees a point if the point is within this many metres of the frame's depth there."""
LEAST_SHARE = 0.05
"""Share of the object's points below which a part joins the nearest larger one, and a segment is ignored."""
ALIKE = 0.5
"""Segments of two frames show one part when they share more than this of the points that both frames show."""
LEAST_FRAMES = 2
"""Minimum number of frames that show two parts apart, as a single mask may be wrong."""


@dataclass(frozen=True, eq=False)
class PartsSeen:
    """The parts found. ``part`` int64 [n]: the part of each of the object's points ``xyz`` float32 [n, 3], metres; 0 is
    the largest. ``class_of``: by part, the class that masks give most often. ``frames``: how many frames show parts."""

    part: NDArray[np.int64]
    class_of: dict[int, int]
    frames: int
    xyz: NDArray[np.floating]

    def split(self, state: Replay, number: int, first_id: int) -> Edit:
        """Return the edit that splits object ``number`` into these parts, with their classes; new parts get ids from
        ``first_id``. Raises PlgsError if there is only one part, or if the object was edited meanwhile."""
        if not np.array_equal(self.xyz, state.points_of(number)):
            what = f"object {number} was edited while its masks were read"
            raise PlgsError("edited-meanwhile", what, CORRECTIONS, "Split it again.", code=ErrorCode.BUSY)
        return making.split(state, number, self.part, first_id, self.class_of)


@dataclass(frozen=True, eq=False)
class _Segment:
    """A frame's segment that covers part of the object. ``holds``, ``seen`` float32 [n]: for each point, the weight of
    the frame's vote if the point lies in this segment, and if it lies in any segment of a thing (0 otherwise)."""

    frame: int
    class_id: int
    holds: NDArray[np.float32]
    seen: NDArray[np.float32]


Progress = Callable[[int, int], object]
"""Called before each frame is read, and after the last, with the numbers of read and all frames. It may raise."""


def parts_seen(
    folder: LiftFolder, state: Replay, number: int, progress: Progress = lambda done, count: None
) -> PartsSeen:
    """Return the parts of object ``number`` that the lift's masks show apart. Raises PlgsError if the scene is gone."""
    return parts_by_views(scene_of_lift(folder).train_frames, state.points_of(number), progress)


def parts_by_views(
    frames: Sequence[Frame], xyz: NDArray[np.floating], progress: Progress = lambda done, count: None
) -> PartsSeen:
    """Return the parts of an object with points ``xyz`` [n, 3], metres, that the masks of at least `LEAST_FRAMES`
    frames show as different things. Points in no mask go to the nearest part. Raises PlgsError for bad files."""
    segments = _segments(frames, xyz, progress)
    if not segments:
        return PartsSeen(np.zeros(len(xyz), np.int64), {}, 0, xyz)
    # The evidence of two views on one point is weighted by the geometric mean of their weights.
    holds, seen = (np.sqrt(np.stack([getattr(each, name) for each in segments])) for name in ("holds", "seen"))
    shared, in_both_frames = holds @ holds.T, holds @ seen.T
    union = in_both_frames + in_both_frames.T - shared
    cluster = join(shared - ALIKE * union).tolist()
    owners: dict[int, set[int]] = {}
    for segment, own in zip(segments, cluster, strict=True):
        owners.setdefault(segment.frame, set()).add(own)
    apart = {frame for frame, shown in owners.items() if len(shown) > 1}  # frames that show several things
    members: dict[int, list[_Segment]] = {}
    for segment, own in zip(segments, cluster, strict=True):
        if segment.frame in apart:
            members.setdefault(own, []).append(segment)
    shown = [own for own in members.values() if len({segment.frame for segment in own}) >= LEAST_FRAMES]
    if len(shown) < 2:
        return PartsSeen(np.zeros(len(xyz), np.int64), {}, 0, xyz)
    part = _voted(np.stack([sum(segment.holds for segment in own) for own in shown]), xyz)
    counts = np.bincount(part, minlength=len(shown))
    order = [each for each in np.argsort(-counts, kind="stable").tolist() if counts[each]]
    rank = np.zeros(len(shown), np.int64)
    rank[order] = np.arange(len(order))
    return PartsSeen(rank[part], {index: _class_of(shown[each]) for index, each in enumerate(order)}, len(apart), xyz)


def _class_of(segments: Sequence[_Segment]) -> int:
    """Return the class id with the most votes by the segments' points."""
    votes: dict[int, float] = {}
    for segment in segments:
        votes[segment.class_id] = votes.get(segment.class_id, 0.0) + float(segment.holds.sum())
    return max(sorted(votes), key=lambda kind: votes[kind])  # ties go to the lower id


def _segments(frames: Sequence[Frame], xyz: NDArray[np.floating], progress: Progress) -> list[_Segment]:
    """Return the thing segments that contain points ``xyz`` [n, 3], from the frames that see most of the points."""
    inside = []
    for number, frame in enumerate(frames):
        inside.append((-len(frame.camera.seen(xyz)[0]), number))
    best = sorted(number for count, number in sorted(inside)[:MOST_FRAMES] if count)
    found: list[_Segment] = []
    for done, number in enumerate(best):
        progress(done, len(best))
        found += _of_frame(number, frames[number], xyz)
    progress(len(best), len(best))
    return found


def _of_frame(number: int, frame: Frame, xyz: NDArray[np.floating]) -> list[_Segment]:
    rows, pixel, far = frame.camera.seen(xyz)
    column, row = pixel.astype(np.int64).T
    depth, mask = frame.depth(frame.size), frame.mask(frame.size)
    near = np.abs(depth[row, column] - far) < SEEN_WITHIN
    rows, shown, far = rows[near], mask.ids[row[near], column[near]], far[near]
    word = resolution_on(frame.camera, far.astype(np.float32), 1.0) ** 2  # as many votes as pixels
    things = {one.id: one.class_id for one in mask.segments if one.is_thing and not one.is_group}
    seen = np.zeros(len(xyz), np.float32)
    known = np.isin(shown, [*things])
    seen[rows[known]] = word[known]
    found = []
    for one, count in zip(*np.unique(shown[known], return_counts=True), strict=True):
        if count >= LEAST_SHARE * len(rows):
            holds = np.zeros(len(xyz), np.float32)
            holds[rows[shown == one]] = word[shown == one]
            found.append(_Segment(number, things[int(one)], holds, seen))
    return found


def _voted(votes: NDArray[np.float32], xyz: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the part with the most ``votes`` [P, n] at each point, int64 [n]. Points without votes, or of a part that
    is too small, get the part of the nearest other point."""
    part = votes.argmax(axis=0)
    known = votes.any(axis=0)
    large = np.bincount(part[known], minlength=len(votes)) >= LEAST_SHARE * len(xyz)
    known &= large[part]
    if known.any() and not known.all():
        part[~known] = part[known][nearest(xyz[~known], xyz[known])[0]]
    return np.asarray(part, np.int64)
