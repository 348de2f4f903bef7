"""Which masks are one object, by the consent of the views (ours, beyond the paper).

Boxes cannot tell a chair from the table it stands under. Here two masks belong together when most views that
see the surface of both show it inside one mask, whatever class that has. So a view that merges two objects,
or splits one, is outvoted, and a class that changes from view to view does no harm. After the idea of view
consensus in MaskClustering (Yan et al., CVPR 2024), with sums in place of its schedule of thresholds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Segment, View
from .masks import PointOfPixel
from .matching import Progress
from .segments import edge_distance


@dataclass(frozen=True)
class ConsensusOptions:
    """A view judges a mask when it sees at least ``visible`` of the mask's points. A mask is inside another
    when that one holds ``contained`` of the points seen. Masks that views mostly do not contain (more than
    ``torn`` of them) are wrong outlines and are left out. Masks are joined while views in favour exceed
    ``consent`` of those that judge both. Objects of fewer than ``min_masks`` masks are dropped; masks of
    fewer than ``min_points`` points take no part. At most ``max_judges`` views, evenly chosen, judge, so that
    many views do not take long.
    """

    visible: float = 0.2
    contained: float = 0.7
    torn: float = 0.5
    consent: float = 0.35
    min_masks: int = 3
    min_points: int = 3
    max_judges: int = 100


@dataclass(frozen=True, eq=False)
class ViewPoints:
    """What one view says of the points it sees: ``row`` int32 [n] in the cloud, ascending; ``segment`` int32
    [n], the id of the segment most of the point's pixels show (0 = void); ``pixels`` int32 [n].
    """

    row: NDArray[np.int32]
    segment: NDArray[np.int32]
    pixels: NDArray[np.int32]


@dataclass(frozen=True)
class MemberMask:
    """A mask of an object. ``consent``: of the times that a view judges this mask together with another one
    of the object, the share in which it shows both inside one mask; None when no view judges such a pair.
    """

    frame: str
    segment: Segment
    consent: float | None


@dataclass(frozen=True, eq=False)
class ObjectMasks:
    """``object_of_point`` int32 [N], 0 = in no object, else 1.. ; ``masks`` those of each object, in the order
    of the views, object i at place i - 1.
    """

    object_of_point: NDArray[np.int32]
    masks: tuple[tuple[MemberMask, ...], ...]


def view_points(view: View, point_of_pixel: NDArray[np.int32]) -> ViewPoints:
    """Sum up one view; ``point_of_pixel`` int32 [H, W], -1 = none. Pixels at a mask's ragged edge count only
    where a point has no others.
    """
    seen = point_of_pixel >= 0
    row = point_of_pixel[seen].astype(np.int64)
    segment = view.mask.ids[seen].astype(np.int64)
    weight = np.where(edge_distance(view.mask.ids)[seen] > 1.5, 1.0, 0.01)
    pairs, inverse = np.unique((row << 32) | segment, return_inverse=True)
    total = np.bincount(inverse.reshape(-1), weight, len(pairs))
    rows, segments = pairs >> 32, pairs & 0xFFFFFFFF
    order = np.lexsort((segments, -np.round(total, 6), rows))
    points, first = np.unique(rows[order], return_index=True)
    pixels = np.bincount(row, minlength=int(points[-1]) + 1 if len(points) else 0)[points]
    return ViewPoints(points.astype(np.int32), segments[order][first].astype(np.int32), pixels.astype(np.int32))


def shown_classes(view: View, summary: ViewPoints) -> NDArray[np.int32]:
    """The class that a view shows at each of its points, int32 [n], 0 = none."""
    class_of = {segment.id: segment.class_id for segment in view.mask.segments}
    present, inverse = np.unique(summary.segment, return_inverse=True)
    return np.array([class_of.get(int(segment), 0) for segment in present], np.int32)[inverse.reshape(-1)]


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
    return objects_of_masks(views, summaries, points, options), summaries


def objects_of_masks(
    views: Sequence[View], summaries: Sequence[ViewPoints], points: int, options: ConsensusOptions
) -> ObjectMasks:
    """Cluster all masks of all views and give each point to the object most of whose masks hold it."""
    masks, view_of_mask, holds = _incidence(views, summaries, points, options.min_points)
    if not masks:
        return ObjectMasks(np.zeros(points, np.int32), ())
    inside, judges, contained = _judgements(summaries, view_of_mask, holds, options)
    sound = np.flatnonzero(judges.sum(1) - contained.sum(1) <= options.torn * judges.sum(1))
    favour = inside[sound] @ inside[sound].T
    judging = judges[sound] @ judges[sound].T
    cluster = join(favour - options.consent * judging)
    names, size = np.unique(cluster, return_counts=True)
    names = names[size >= options.min_masks]
    if not len(names):
        return ObjectMasks(np.zeros(points, np.int32), ())
    members = [np.flatnonzero(cluster == name) for name in names]
    votes = np.stack([np.asarray(holds[sound[rows]].sum(0)).reshape(-1) for rows in members])
    owner = np.where(votes.max(0) > 0, votes.argmax(0) + 1, 0).astype(np.int32)
    found = []
    for rows in members:
        shares = consents(favour[np.ix_(rows, rows)], judging[np.ix_(rows, rows)])
        chosen = (masks[row] for row in sound[rows])
        found.append(tuple(MemberMask(frame, each, share) for (frame, each), share in zip(chosen, shares, strict=True)))
    return ObjectMasks(owner, tuple(found))


def consents(favour: NDArray[np.floating], judging: NDArray[np.floating]) -> list[float | None]:
    """``MemberMask.consent`` of an object's m masks, from how many views judge each pair of them, and how many
    of these are in favour, both [m, m]. A mask's judgement of itself does not count.
    """
    judged = judging.sum(1) - np.diag(judging)
    agreed = favour.sum(1) - np.diag(favour)
    return [float(yes) / float(all_) if all_ > 0 else None for yes, all_ in zip(agreed, judged, strict=True)]


def join(weight: NDArray[np.floating]) -> NDArray[np.int64]:
    """Greedy joining of the pair with the greatest summed weight while it is positive: the cluster of each
    row, int64 [M], named by its lowest row. ``weight`` float [M, M], symmetric. Ties go to the lower rows.
    """
    weight = np.array(weight, np.float64)
    np.fill_diagonal(weight, -np.inf)
    cluster = np.arange(len(weight))
    partner = weight.argmax(1)
    best = weight[cluster, partner] if len(weight) else np.zeros(0)
    while len(weight):
        i = int(best.argmax())
        if best[i] <= 1e-9:
            break
        i, j = sorted((i, int(partner[i])))
        cluster[cluster == j] = i
        joined = weight[i] + weight[j]
        weight[i], weight[:, i] = joined, joined
        weight[j], weight[:, j] = -np.inf, -np.inf
        best[j] = -np.inf
        # Rows that had i or j as partner look again; others only have to look at what i has become.
        for row in np.flatnonzero((partner == i) | (partner == j) | (np.arange(len(weight)) == i)):
            partner[row] = weight[row].argmax()
            best[row] = weight[row, partner[row]]
        better = (joined > best) | ((joined == best) & (i < partner))
        better[[i, j]] = False
        partner[better], best[better] = i, joined[better]
    return cluster


def _judgements(
    summaries: Sequence[ViewPoints], view_of_mask: NDArray[np.int64], holds: Any, options: ConsensusOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """What the judging views say of M masks, each 0 or 1: ``inside`` [M, K] of K masks of those views,
    ``judges`` [M, V] whether a view sees enough of the mask, ``contained`` [M, V] whether it shows it inside
    one mask.
    """
    judging = np.unique(np.linspace(0, len(summaries) - 1, options.max_judges).round().astype(np.int64))
    holders = np.flatnonzero(np.isin(view_of_mask, judging))
    column = np.searchsorted(judging, view_of_mask[holders])
    common = (holds @ holds[holders].T).toarray()
    seen = (holds @ _sight([summaries[view] for view in judging], holds.shape[1]).T).toarray()
    labelled = np.zeros_like(seen)
    np.add.at(labelled.T, column, common.T)
    size = np.asarray(holds.sum(1)).reshape(-1, 1)
    # A view that shows mostly void there has missed the object: it says nothing about what belongs together.
    judges = (seen >= np.maximum(options.visible * size, options.min_points)) & (labelled >= 0.5 * seen)
    inside = (common >= options.contained * labelled[:, column]) & judges[:, column]
    contained = np.zeros(judges.shape, bool)
    np.logical_or.at(contained.T, column, inside.T)
    return inside.astype(np.float32), judges.astype(np.float32), contained.astype(np.float32)


def _sight(summaries: Sequence[ViewPoints], points: int) -> Any:
    """Which points each view sees: sparse 0/1 [views, points]."""
    from scipy import sparse

    ends = np.cumsum([0, *(len(summary.row) for summary in summaries)])
    rows = np.concatenate([summary.row for summary in summaries])
    return sparse.csr_matrix((np.ones(len(rows), np.float32), rows, ends), (len(summaries), points))


def _incidence(
    views: Sequence[View], summaries: Sequence[ViewPoints], points: int, min_points: int
) -> tuple[list[tuple[str, Segment]], NDArray[np.int64], Any]:
    """All masks with enough points, the view of each, and the sparse 0/1 matrix masks x points of what they
    hold.
    """
    from scipy import sparse

    masks: list[tuple[str, Segment]] = []
    view_of_mask: list[int] = []
    held: list[NDArray[np.int32]] = []
    for number, (view, summary) in enumerate(zip(views, summaries, strict=True)):
        for segment in sorted(view.mask.segments, key=lambda each: each.id):
            rows = summary.row[summary.segment == segment.id]
            if segment.id > 0 and len(rows) >= min_points:
                masks.append((view.name, segment))
                view_of_mask.append(number)
                held.append(rows)
    if not masks:
        return masks, np.zeros(0, np.int64), None
    ends = np.cumsum([0, *map(len, held)])
    matrix = sparse.csr_matrix((np.ones(ends[-1], np.float32), np.concatenate(held), ends), (len(masks), points))
    return masks, np.array(view_of_mask), matrix
