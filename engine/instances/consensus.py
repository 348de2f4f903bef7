"""Which masks are one object, by the agreement of the views (ours, beyond the paper).

Boxes cannot tell a chair from the table it stands under. Here two masks belong together when most views that
see the surface of both show it inside one mask, whatever class that has. So a view that merges two objects,
or splits one, is outvoted, and a class that changes from view to view does no harm. After the idea of view
consensus in MaskClustering (Yan et al., CVPR 2024), with sums in place of its schedule of thresholds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Segment, View
from .agreement import Agreement, JudgingRules, MasksInSpace, ViewPoints, judge_masks, masks_in_space, view_points
from .joining import join
from .keyframes import choose_keyframes
from .masks import PointOfPixel
from .matching import Progress


@dataclass(frozen=True)
class ConsensusOptions:
    """Masks are joined while views in favour exceed ``agreement`` of those that judge both. An object needs masks in
    ``support`` of the views that see at least half of its points, and at least ``min_masks``; where few views see it,
    all of these but one, and 2 at least. Where there are more than ``most_masks`` masks, those of keyframes are joined;
    those of the other views go to the object that owns most of their points. A tracker has the word of ``tracker``
    views about each two masks that it followed: it is in favour where both have one track.
    """

    rules: JudgingRules = JudgingRules()
    agreement: float = 0.35
    min_masks: int = 3
    support: float = 0.1
    most_masks: int = 4000
    tracker: float = 1.0


@dataclass(frozen=True)
class MemberMask:
    """A mask of an object. ``agreement``: of the times that a view judges this mask together with another one
    of the object, the share in which it shows both inside one mask; None when no view judges such a pair.
    """

    frame: str
    segment: Segment
    agreement: float | None


@dataclass(frozen=True, eq=False)
class ObjectMasks:
    """``object_of_point`` int32 [N], 0 = in no object, else 1.. ; ``masks`` those of each object, object i at
    place i - 1.
    """

    object_of_point: NDArray[np.int32]
    masks: tuple[tuple[MemberMask, ...], ...]


def find_objects(
    views: Sequence[View],
    point_of_pixel: PointOfPixel,
    points: int,
    options: ConsensusOptions,
    progress: Progress | None = None,
) -> tuple[ObjectMasks, list[ViewPoints]]:
    """Objects of a cloud of ``points`` points, and what each view says of the points (``vote_classes`` wants
    it too).
    """
    summaries = []
    for done, view in enumerate(views, start=1):
        summaries.append(view_points(view, point_of_pixel(view)))
        if progress:
            progress(done, len(views))
    space = masks_in_space(views, summaries, points, options.rules.min_points)
    keyframes = choose_keyframes(space, options.most_masks)
    found = objects_of_masks(space.of_views(keyframes), options)
    others = np.flatnonzero(~np.isin(space.view, keyframes))
    return with_contained(found, space, others, options.rules.contained), summaries


def with_contained(
    objects: ObjectMasks, space: MasksInSpace, rows: NDArray[np.intp], contained: float
) -> ObjectMasks:
    """The objects with those masks ``rows`` (of views that are no keyframes) of whose points they own ``contained``."""
    masks = [list(own) for own in objects.masks]
    for row in rows:
        owner = objects.object_of_point[space.holds[row].indices]
        owned = np.bincount(owner, minlength=len(masks) + 1)
        owned[0] = 0
        if owned.max() >= contained * len(owner):
            frame, segment = space.masks[row]
            masks[int(owned.argmax()) - 1].append(MemberMask(frame, segment, None))
    return ObjectMasks(objects.object_of_point, tuple(map(tuple, masks)))


def objects_of_masks(space: MasksInSpace, options: ConsensusOptions) -> ObjectMasks:
    """Cluster all masks and give each point to the object most of whose masks hold it."""
    points = space.holds.shape[1]
    nothing = ObjectMasks(np.zeros(points, np.int32), ())
    if not space.masks:
        return nothing
    judgement, sound = judge_masks(space, options.rules)
    rows = np.flatnonzero(sound)
    favour, judging = pairwise(judgement, rows)
    weight = favour - options.agreement * judging
    if any(segment.track is not None for _, segment in space.masks):
        same, followed = tracked(space, rows)
        weight += options.tracker * (same - options.agreement * followed)
    cluster = join(weight)
    members = [rows[cluster == name] for name in np.unique(cluster)]
    members = [each for each in members if _is_supported(space, each, options)]
    if not members:
        return nothing
    votes = np.stack([np.asarray(space.holds[each].sum(0)).reshape(-1) for each in members])
    owner = np.where(votes.max(0) > 0, votes.argmax(0) + 1, 0).astype(np.int32)
    place = np.zeros(len(space.masks), np.intp)
    place[rows] = np.arange(len(rows))
    found = []
    for each in members:
        own = np.ix_(place[each], place[each])
        shares = agreements(favour[own], judging[own])
        chosen = (space.masks[row] for row in each)
        found.append(tuple(MemberMask(frame, one, share) for (frame, one), share in zip(chosen, shares, strict=True)))
    return ObjectMasks(owner, tuple(found))


def pairwise(judgement: Agreement, rows: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How many views show two of the masks ``rows`` inside one mask, and how many judge both, float32 [R, R] each."""
    inside = judgement.inside[rows]
    judges = judgement.judges[rows]
    return (inside @ inside.T).toarray(), judges @ judges.T


def tracked(space: MasksInSpace, rows: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Which pairs of the masks ``rows`` a tracker gave one track, and which it followed at all, 0/1 float32 [R, R]. Two
    masks of one view are left out: no track is twice in a frame."""
    track = np.array([-1 if space.masks[row][1].track is None else space.masks[row][1].track for row in rows], np.int64)
    view = space.view[rows]
    followed = (track[:, None] >= 0) & (track[None, :] >= 0) & (view[:, None] != view[None, :])
    same = followed & (track[:, None] == track[None, :])
    return same.astype(np.float32), followed.astype(np.float32)


def _is_supported(space: MasksInSpace, members: NDArray[np.intp], options: ConsensusOptions) -> bool:
    """Whether enough views that see the object have a mask of it."""
    own = np.asarray(space.holds[members].sum(0)).reshape(-1) > 0
    seen = space.sight @ own.astype(np.float32)
    seeing = int((seen >= 0.5 * own.sum()).sum())
    least = min(options.min_masks, max(2, seeing - 1))
    return len(np.unique(space.view[members])) >= max(least, options.support * seeing)


def agreements(favour: NDArray[np.floating], judging: NDArray[np.floating]) -> list[float | None]:
    """``MemberMask.agreement`` of an object's m masks, from how many views judge each pair of them, and how many
    of these are in favour, both [m, m]. A mask's judgement of itself does not count.
    """
    judged = judging.sum(1) - np.diag(judging)
    agreed = favour.sum(1) - np.diag(favour)
    return [float(yes) / float(all_) if all_ > 0 else None for yes, all_ in zip(agreed, judged, strict=True)]
