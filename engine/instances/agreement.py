"""The view agreement: which views judge a mask, and inside which of their own masks they show it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..presets.preset import EvidenceKind
from ..scene import OnDemand, Segment, View, chained, evidence, resolution_of
from .records import ObjectMask
from .segments import edge_distance

PAIRS_AT_A_TIME = 8192
"""Pairs of masks whose common points are looked up at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class ViewPoints:
    """What one view shows at the points it sees: ``row`` int32 [n] in the cloud, ascending; ``segment`` int32 [n], the
    id of the segment that most of the point's pixels show (0 = void); ``pixels`` float32 [n] at the size of the frame's
    own mask; ``resolution`` float32 [n], the mean number of pixels per centimetre; ``share`` that of the segment."""

    row: NDArray[np.int32]
    segment: NDArray[np.int32]
    pixels: NDArray[np.float32]
    resolution: NDArray[np.float32]
    share: NDArray[np.float32] | float = 1.0

    @property
    def shares(self) -> NDArray[np.float32]:
        """``share`` of each point, float32 [n]."""
        return np.broadcast_to(np.float32(self.share), self.row.shape)


@dataclass(frozen=True, eq=False)
class ViewsOnCloud:
    """``views`` and what they see of a cloud: ``point_of_pixel``, the point that each of their pixels shows, int32
    [H, W] per view (-1 = none), and ``seen``, what each view shows at the points."""

    views: Sequence[View]
    point_of_pixel: Sequence[NDArray[np.int32]]
    seen: Sequence[ViewPoints]

    @classmethod
    def of(cls, views: Sequence[View], point_of_pixel: Sequence[NDArray[np.int32]]) -> ViewsOnCloud:
        """The views with ``seen``, which is computed on demand."""
        seen = OnDemand(len(views), lambda number: view_points(views[number], point_of_pixel[number]))
        return cls(views, point_of_pixel, seen)

    def and_also(self, others: ViewsOnCloud) -> ViewsOnCloud:
        """These views, then the others."""
        rows = chained(self.point_of_pixel, others.point_of_pixel)
        return ViewsOnCloud(chained(self.views, others.views), rows, chained(self.seen, others.seen))

    def layers(self) -> ViewsOnCloud:
        """The layers of the views, each as a view, in their order."""
        pairs = [(number, layer) for number, view in enumerate(self.views) for layer in range(len(view.layers))]
        views = OnDemand(len(pairs), lambda each: self.views[pairs[each][0]].layer(pairs[each][1]))
        return ViewsOnCloud.of(views, OnDemand(len(pairs), lambda each: self.point_of_pixel[pairs[each][0]]))

    def by_frame(self) -> list[list[int]]:
        """The numbers of the views of each frame: its own view and its layers, which are held back together."""
        of_frame: dict[str, list[int]] = {}
        for number, view in enumerate(self.views):
            of_frame.setdefault(view.frame or view.name, []).append(number)
        return list(of_frame.values())

    def looked_at(self, progress: Callable[[int, int], object]) -> ViewsOnCloud:
        """The views with ``seen`` computed now, in memory; ``progress`` is called after each view."""
        seen = []
        for done, one in enumerate(self.seen, start=1):
            seen.append(one)
            progress(done, len(self.views))
        return replace(self, seen=seen)

    def only(self, numbers: NDArray[np.integer]) -> ViewsOnCloud:
        """The views with these numbers [n]."""
        views, rows, seen = ([own[n] for n in numbers] for own in (self.views, self.point_of_pixel, self.seen))
        return ViewsOnCloud(views, rows, seen)


@dataclass(frozen=True, eq=False)
class MasksInSpace:
    """M ``masks`` of V views. ``view`` int64 [M], the view of each; ``is_thing`` bool [M]; ``holds`` sparse 0/1 [M, N],
    the points of the cloud in each mask; ``sight`` sparse 0/1 [V, N], the points that each view sees; ``word`` sparse
    [V, N], the weight of the view's evidence on each of them."""

    masks: list[ObjectMask]
    view: NDArray[np.int64]
    is_thing: NDArray[np.bool_]
    holds: Any
    sight: Any
    word: Any

    @property
    def size(self) -> NDArray[np.int64]:
        """Number of points in each mask, int64 [M]."""
        return np.diff(self.holds.indptr).astype(np.int64)

    def of_views(self, views: NDArray[np.int64]) -> MasksInSpace:
        """Only the masks of these views; the other views then see nothing."""
        rows = np.flatnonzero(np.isin(self.view, views))
        chosen = [self.masks[row] for row in rows]
        seeing = np.isin(np.arange(self.sight.shape[0]), views).astype(np.float32)
        sight, word = ((sparse.diags(seeing) @ of_views).tocsr() for of_views in (self.sight, self.word))
        return MasksInSpace(chosen, self.view[rows], self.is_thing[rows], self.holds[rows], sight, word)

    def words(self, rows: NDArray[np.integer]) -> Any:
        """Sparse [n, N]: the points in each of the masks ``rows``, with the weight of its view's evidence on them."""
        return self.holds[rows].multiply(self.word[self.view[rows]]).tocsr()


@dataclass(frozen=True, eq=False)
class Agreement:
    """``judges`` float32 [M, V]: how much the view's judgement of mask i counts, from 0, not at all, to 1, where it
    resolves the mask as well as its own view. ``inside`` sparse [M, M]: the same where mask i lies inside mask k of the
    view (or is k). ``contained`` float32 [M, V]: the same where the view shows mask i inside one of its own."""

    inside: Any
    judges: NDArray[np.float32]
    contained: NDArray[np.float32]


@dataclass(frozen=True)
class JudgingRules:
    """A view judges a mask when it sees at least ``visible`` of the mask's points, at least ``min_points``, and most of
    them are not void. A mask is inside another that holds at least ``contained`` of its points seen and labelled. A
    mask is under-segmented (it covers several objects) when more than ``under_segmented`` of its judges do not show it
    inside one mask. A stuff mask swallows a thing's mask when it has more than ``swallowing`` times the points that
    both have."""

    visible: float = 0.2
    contained: float = 0.7
    under_segmented: float = 0.5
    swallowing: float = 2.0
    min_points: int = 3


def view_points(view: View, point_of_pixel: NDArray[np.int32]) -> ViewPoints:
    """Summarise one view; ``point_of_pixel`` int32 [H, W], -1 = none. Pixels at a mask's ragged edge count only where a
    point has no others."""
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
    """The class that a view shows at each of its points, int32 [n], 0 = none."""
    class_of = {segment.id: segment.class_id for segment in view.mask.segments}
    present, inverse = np.unique(summary.segment, return_inverse=True)
    return np.array([class_of.get(int(segment), 0) for segment in present], np.int32)[inverse.reshape(-1)]


def words_of_views(
    seeing: ViewsOnCloud, points: int, class_ids: NDArray[np.int64], kind: EvidenceKind
) -> tuple[list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]], NDArray[np.float64]]:
    """For each view, the rows of its points, the columns in ``class_ids`` [C] of the classes that it shows there, and
    the weights of its votes, [n] each; and the sum of all votes, float64 [points, C]."""
    said = []
    total = np.zeros((points, len(class_ids)))  # float64: where a view is taken out, nothing must be left of it
    for view, seen in zip(seeing.views, seeing.seen, strict=True):
        shown = shown_classes(view, seen)
        column = np.minimum(np.searchsorted(class_ids, shown), len(class_ids) - 1)  # other classes are rejected below
        known = class_ids[column] == shown
        word = evidence(kind, seen.pixels[known], seen.resolution[known]).astype(np.float64) * seen.shares[known]
        said.append((seen.row[known].astype(np.int64), column[known], word))
        total[said[-1][:2]] += word  # a view has each point once
    return said, total


def masks_of_view(view: View, seen: ViewPoints, min_points: int) -> Iterator[tuple[Segment, NDArray[np.int32]]]:
    """The view's masks that have at least ``min_points`` points, and the rows int32 [n] of these points. Regions that
    may be several objects (a thing's class without an instance) are left out."""
    for segment in sorted(view.mask.segments, key=lambda each: each.id):
        rows = seen.row[seen.segment == segment.id]
        if segment.id > 0 and len(rows) >= min_points and not segment.is_group:
            yield segment, rows


def masks_in_space(seeing: ViewsOnCloud, points: int, min_points: int, kind: EvidenceKind = "views") -> MasksInSpace:
    """All masks with at least ``min_points`` of the cloud's ``points``, and the views' evidence of that ``kind``."""
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
    word = sight.copy()
    word.data = evidence(kind, pixels, resolution).astype(np.float32)
    return MasksInSpace(masks, np.array(view_of_mask, np.int64), is_thing, holds, sight, word)


def _rows_of_ones(columns: Sequence[NDArray[np.int32]], width: int) -> Any:
    """Sparse 0/1 [len(columns), width] with ones at each row's columns."""
    ends = np.cumsum([0, *map(len, columns)])
    joined = np.concatenate([np.zeros(0, np.int32), *columns])
    return sparse.csr_matrix((np.ones(len(joined), np.float32), joined, ends), (len(columns), width))


def judge_masks(space: MasksInSpace, rules: JudgingRules) -> tuple[Agreement, NDArray[np.bool_]]:
    """How all views judge all masks, and which masks are sound, bool [M]: shown inside one mask by most judges. A view
    abstains on a mask that it shows inside an under-segmented mask, or swallowed by stuff where most views show a
    thing. Such a view has missed the object, so it cannot tell what belongs together."""
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
    """The judgements before any view abstains."""
    common = (space.holds @ space.holds.T).tocoo()
    seen = (space.holds @ space.sight.T).toarray()
    labelled = np.zeros_like(seen)
    np.add.at(labelled, (common.row, space.view[common.col]), common.data)
    size = space.size.reshape(-1, 1)
    # How well each view resolves each mask, compared with the view that has the mask.
    word = (space.holds @ space.word.T).toarray() / np.maximum(seen, 1)
    own = word[np.arange(len(space.masks)), space.view]
    resolved = np.minimum(word / np.maximum(own, 1e-12)[:, None], 1.0)
    judges = (seen >= np.maximum(rules.visible * size, rules.min_points)) & (labelled >= 0.5 * seen)
    judges = judges * resolved
    column_view = space.view[common.col]
    lies_inside = common.data >= rules.contained * labelled[common.row, column_view]
    lies_inside &= judges[common.row, column_view] > 0
    return _agreement(common.row[lies_inside], common.col[lies_inside], judges.astype(np.float32), space.view)


def _agreement(
    row: NDArray[np.intp], column: NDArray[np.intp], judges: NDArray[np.float32], view: NDArray[np.int64]
) -> Agreement:
    word = judges[row, view[column]]
    inside = sparse.csr_matrix((word, (row, column)), (len(view), len(view)))
    contained = np.zeros_like(judges)
    contained[row, view[column]] = word
    return Agreement(inside, judges, contained)
