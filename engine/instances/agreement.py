"""Compares the masks of different views: which views can judge another view's mask, and which agree with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..presets.preset import EvidenceKind
from ..scene import VOID, OnDemand, Segment, View, chained, evidence, made_ahead, resolution_of
from .records import ObjectMask
from .segments import edge_distance

PAIRS_AT_A_TIME = 8192
"""Pairs of masks whose common points are looked up at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class ViewPoints:
    """What one view shows at the cloud's points that it sees. ``row`` int32 [n]: the points' indices, ascending;
    ``segment`` int32 [n]: the id of the segment that most of a point's pixels show (0 = void); ``pixels`` float32 [n]:
    how many pixels, at the mask's own size; ``resolution`` float32 [n]: how many per centimetre; ``share``: the weight
    of the segment's votes (`Segment.share`)."""

    row: NDArray[np.int32]
    segment: NDArray[np.int32]
    pixels: NDArray[np.float32]
    resolution: NDArray[np.float32]
    share: NDArray[np.float32] | float = 1.0

    @property
    def shares(self) -> NDArray[np.float32]:
        """``share`` as an array, one value for each point, float32 [n]."""
        return np.broadcast_to(np.float32(self.share), self.row.shape)


@dataclass(frozen=True, eq=False)
class ViewsOnCloud:
    """Views and what they see of a point cloud. ``point_of_pixel``: the index of the point that each pixel of a view
    shows, int32 [H, W], -1 = none; ``seen``: the segments that each view shows at its points."""

    views: Sequence[View]
    point_of_pixel: Sequence[NDArray[np.int32]]
    seen: Sequence[ViewPoints]

    @classmethod
    def of(cls, views: Sequence[View], point_of_pixel: Sequence[NDArray[np.int32]]) -> ViewsOnCloud:
        """Return the views with what they see of the cloud by ``point_of_pixel``; ``seen`` is computed when read."""
        seen = OnDemand(len(views), lambda number: view_points(views[number], point_of_pixel[number]))
        return cls(views, point_of_pixel, seen)

    def and_also(self, others: ViewsOnCloud) -> ViewsOnCloud:
        """Return these views followed by ``others``."""
        rows = chained(self.point_of_pixel, others.point_of_pixel)
        return ViewsOnCloud(chained(self.views, others.views), rows, chained(self.seen, others.seen))

    def layers(self) -> ViewsOnCloud:
        """Return the views' layers (detections that overlap the mask), each as a view of its own, in order."""
        pairs = [(number, layer) for number, view in enumerate(self.views) for layer in range(len(view.layers))]
        views = OnDemand(len(pairs), lambda each: self.views[pairs[each][0]].layer(pairs[each][1]))
        return ViewsOnCloud.of(views, OnDemand(len(pairs), lambda each: self.point_of_pixel[pairs[each][0]]))

    def by_frame(self) -> list[list[int]]:
        """Return the indices of each frame's views: its own view and its layers, which are held back together."""
        of_frame: dict[str, list[int]] = {}
        for number, view in enumerate(self.views):
            of_frame.setdefault(view.frame or view.name, []).append(number)
        return list(of_frame.values())

    def looked_at(self, progress: Callable[[int, int], object]) -> ViewsOnCloud:
        """Return the same views, with ``seen`` computed now and kept in memory. Calls ``progress`` after each view."""
        seen = []
        for done, one in enumerate(made_ahead(range(len(self.seen)), self.seen.__getitem__), start=1):
            seen.append(one)
            progress(done, len(self.views))
        return replace(self, seen=seen)

    def only(self, numbers: NDArray[np.integer]) -> ViewsOnCloud:
        """Return the views with the indices ``numbers``, int [n], in this order."""
        views, rows, seen = ([own[n] for n in numbers] for own in (self.views, self.point_of_pixel, self.seen))
        return ViewsOnCloud(views, rows, seen)


@dataclass(frozen=True, eq=False)
class MasksInSpace:
    """M ``masks`` of V views, as points of a cloud of N. ``view`` int64 [M]: the view of each; ``is_thing`` bool [M];
    ``holds`` sparse 0/1 [M, N]: the points in each mask; ``sight`` sparse 0/1 [V, N]: the points that each view sees;
    ``weight`` sparse [V, N]: how much the view's vote on each of them counts."""

    masks: list[ObjectMask]
    view: NDArray[np.int64]
    is_thing: NDArray[np.bool_]
    holds: Any
    sight: Any
    weight: Any

    @property
    def size(self) -> NDArray[np.int64]:
        """The number of points in each mask, int64 [M]."""
        return np.diff(self.holds.indptr).astype(np.int64)

    def of_views(self, views: NDArray[np.int64]) -> MasksInSpace:
        """Return only the masks of these views; the other views keep their index, but see nothing."""
        rows = np.flatnonzero(np.isin(self.view, views))
        chosen = [self.masks[row] for row in rows]
        seeing = np.isin(np.arange(self.sight.shape[0]), views).astype(np.float32)
        sight, weight = ((sparse.diags(seeing) @ of_views).tocsr() for of_views in (self.sight, self.weight))
        return MasksInSpace(chosen, self.view[rows], self.is_thing[rows], self.holds[rows], sight, weight)

    def votes_in(self, rows: NDArray[np.integer]) -> Any:
        """Return the weights of the votes of the masks ``rows`` [n] on their points, sparse [n, N]."""
        return self.holds[rows].multiply(self.weight[self.view[rows]]).tocsr()


@dataclass(frozen=True, eq=False)
class Agreement:
    """How V views judge M masks. ``judges`` float32 [M, V]: how much view v's judgement of mask i counts, from 0 to 1;
    it is 1 if v resolves the mask as well as the view that it is from. ``inside`` sparse [M, M]: this weight if mask i
    lies inside mask k of another view, or is k. ``contained`` float32 [M, V]: this weight if i lies inside a mask of
    v."""

    inside: Any
    judges: NDArray[np.float32]
    contained: NDArray[np.float32]


@dataclass(frozen=True)
class JudgingRules:
    """A view judges a mask if it sees at least the share ``visible`` of the mask's points, at least ``min_points`` of
    them, and most are not void. A mask is inside another that holds at least the share ``contained`` of its seen and
    labelled points. A mask is under-segmented (covers several objects) if more than the share ``under_segmented`` of
    its judges do not show it inside one mask. A stuff mask swallows a thing's mask if it has more than ``swallowing``
    times their common points."""

    visible: float = 0.2
    contained: float = 0.7
    under_segmented: float = 0.5
    swallowing: float = 2.0
    min_points: int = 3


def view_points(view: View, point_of_pixel: NDArray[np.int32]) -> ViewPoints:
    """Return what a view shows at the points it sees. ``point_of_pixel`` int32 [H, W]: each pixel's point, -1 = none.
    Pixels at a mask's edge, which is often ragged, count only for points that no other pixel shows."""
    seen = point_of_pixel >= 0
    row = point_of_pixel[seen].astype(np.int64)
    segment = view.mask.ids[seen].astype(np.int64)
    weight = np.where(edge_distance(view.mask.ids)[seen] > 1.5, 1.0, 0.01)  # it is 1 at an edge, and 2 beside it
    pairs, inverse = np.unique((row << 32) | segment, return_inverse=True)  # two in one, as `unique` of rows is slow
    total = np.bincount(inverse.reshape(-1), weight, len(pairs))
    rows, segments = pairs >> 32, pairs & 0xFFFFFFFF
    order = np.lexsort((segments, -np.round(total, 6), rows))  # sums that differ by rounding alone are a tie
    points, first = np.unique(rows[order], return_index=True)
    index = np.searchsorted(points, row)
    pixels = np.bincount(index, minlength=len(points))
    resolution = np.bincount(index, resolution_of(view)[seen], len(points)) / np.maximum(pixels, 1)
    shown = segments[order][first].astype(np.int32)
    shares = {segment.id: segment.share for segment in view.mask.segments if segment.share != 1.0}
    return ViewPoints(
        points.astype(np.int32),
        shown,
        (pixels * view.mask_scale**2).astype(np.float32),
        resolution.astype(np.float32),
        np.array([shares.get(each, 1.0) for each in shown.tolist()], np.float32) if shares else 1.0,
    )


def shown_classes(view: View, summary: ViewPoints) -> NDArray[np.int32]:
    """Return the class id that a ``view`` shows at each point of its ``summary``, int32 [n], 0 = none."""
    class_of = {0: VOID} | {segment.id: segment.class_id for segment in view.mask.segments}
    ids = np.array(sorted(class_of))
    column = np.minimum(np.searchsorted(ids, summary.segment), len(ids) - 1)
    classes = np.array([class_of[one] for one in ids.tolist()], np.int32)
    return np.where(ids[column] == summary.segment, classes[column], np.int32(VOID))


def votes_of_views(
    seeing: ViewsOnCloud, points: int, class_ids: NDArray[np.int64], kind: EvidenceKind
) -> tuple[list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]], NDArray[np.float64]]:
    """Return each view's class votes: indices of points, indices in ``class_ids`` [C] of the classes that it shows
    there, and weights by ``kind``, arrays [n]. Also return the sum of all votes, float64 [points, C]."""
    said = []
    total = np.zeros((points, len(class_ids)))  # float64: where a view is taken out, nothing must be left of it
    for view, seen in zip(seeing.views, seeing.seen, strict=True):
        shown = shown_classes(view, seen)
        column = np.minimum(np.searchsorted(class_ids, shown), len(class_ids) - 1)  # other classes are rejected below
        known = class_ids[column] == shown
        weight = evidence(kind, seen.pixels[known], seen.resolution[known]).astype(np.float64) * seen.shares[known]
        said.append((seen.row[known].astype(np.int64), column[known], weight))
        total[said[-1][:2]] += weight  # a view has each point once
    return said, total


def masks_of_view(view: View, seen: ViewPoints, min_points: int) -> Iterator[tuple[Segment, NDArray[np.int32]]]:
    """Yield the view's masks that have at least ``min_points`` points, with the indices of these points, int32 [n].
    Leaves out regions that may be several objects (a thing's class without an instance)."""
    for segment in sorted(view.mask.segments, key=lambda each: each.id):
        rows = seen.row[seen.segment == segment.id]
        if segment.id > 0 and len(rows) >= min_points and not segment.is_group:
            yield segment, rows


def masks_in_space(seeing: ViewsOnCloud, points: int, min_points: int, kind: EvidenceKind = "views") -> MasksInSpace:
    """Return all masks with at least ``min_points`` of the cloud's ``points``; ``kind`` says how votes count."""
    summaries = seeing.seen
    masks: list[ObjectMask] = []
    view_of_mask: list[int] = []
    held: list[NDArray[np.int32]] = []
    for number, (view, summary) in enumerate(zip(seeing.views, summaries, strict=True)):
        for segment, rows in masks_of_view(view, summary, min_points):
            masks.append(ObjectMask(view.name, segment))
            view_of_mask.append(number)
            held.append(rows)
    is_thing = np.array([mask.segment.is_thing for mask in masks], bool)
    holds = _rows_of_ones(held, points)
    sight = _rows_of_ones([summary.row for summary in summaries], points)
    pixels = np.concatenate([np.zeros(0, np.float32), *(one.pixels for one in summaries)])
    resolution = np.concatenate([np.zeros(0, np.float32), *(one.resolution for one in summaries)])
    weight = sight.copy()
    weight.data = evidence(kind, pixels, resolution).astype(np.float32)
    return MasksInSpace(masks, np.array(view_of_mask, np.int64), is_thing, holds, sight, weight)


def _rows_of_ones(columns: Sequence[NDArray[np.int32]], width: int) -> Any:
    """Return a sparse 0/1 matrix [len(columns), width] with ones at each row's ``columns``."""
    ends = np.cumsum([0, *map(len, columns)])
    joined = np.concatenate([np.zeros(0, np.int32), *columns])
    return sparse.csr_matrix((np.ones(len(joined), np.float32), joined, ends), (len(columns), width))


def judge_masks(space: MasksInSpace, rules: JudgingRules) -> tuple[Agreement, NDArray[np.bool_]]:
    """Let all views judge all masks. Return the agreement, and which masks are sound, bool [M]: most judges show each
    inside one mask. A view's judgement of a mask does not count if the view shows it inside an under-segmented mask, or
    inside stuff where most views show a thing: such a view missed the object, and cannot tell what belongs together."""
    first = _first_judgement(space, rules)
    judged = first.judges.sum(1)
    sound = judged - first.contained.sum(1) <= rules.under_segmented * judged
    inside = first.inside.tocoo()
    row, column = inside.row, inside.col
    swallowed = space.is_thing[row] & ~space.is_thing[column]
    pairs = np.flatnonzero(swallowed)
    for start in range(0, len(pairs), PAIRS_AT_A_TIME):
        some = pairs[start : start + PAIRS_AT_A_TIME]
        common = np.asarray(space.holds[row[some]].multiply(space.holds[column[some]]).sum(1)).reshape(-1)
        swallowed[some] = space.size[column[some]] > rules.swallowing * common
    # Where most views see no thing, the thing was invented.
    swallowing = np.zeros_like(first.judges)
    swallowing[row[swallowed], space.view[column[swallowed]]] = inside.data[swallowed]
    swallowed &= (swallowing.sum(1) <= 0.5 * judged)[row]
    abstains = swallowed | ~sound[column]
    judges = first.judges.copy()
    judges[row[abstains], space.view[column[abstains]]] = 0
    return _agreement(row[~abstains], column[~abstains], judges, space.view), sound


def _first_judgement(space: MasksInSpace, rules: JudgingRules) -> Agreement:
    """Return all judgements, before `judge_masks` removes those of views that missed the object."""
    common = (space.holds @ space.holds.T).tocoo()
    seen = (space.holds @ space.sight.T).toarray()
    labelled = np.zeros_like(seen)
    np.add.at(labelled, (common.row, space.view[common.col]), common.data)
    size = space.size.reshape(-1, 1)
    # How well each view resolves each mask, compared with the view that has the mask.
    weight = (space.holds @ space.weight.T).toarray() / np.maximum(seen, 1)
    own = weight[np.arange(len(space.masks)), space.view]
    resolved = np.minimum(weight / np.maximum(own, 1e-12)[:, None], 1.0)
    judges = (seen >= np.maximum(rules.visible * size, rules.min_points)) & (labelled >= 0.5 * seen)
    judges = judges * resolved
    column_view = space.view[common.col]
    lies_inside = common.data >= rules.contained * labelled[common.row, column_view]
    lies_inside &= judges[common.row, column_view] > 0
    return _agreement(common.row[lies_inside], common.col[lies_inside], judges.astype(np.float32), space.view)


def _agreement(
    row: NDArray[np.intp], column: NDArray[np.intp], judges: NDArray[np.float32], view: NDArray[np.int64]
) -> Agreement:
    weight = judges[row, view[column]]
    inside = sparse.csr_matrix((weight, (row, column)), (len(view), len(view)))
    contained = np.zeros_like(judges)
    contained[row, view[column]] = weight
    return Agreement(inside, judges, contained)
