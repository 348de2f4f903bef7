"""Lets segments and points vote on panoptic labels, at the resolution of the masks (ours, beyond the paper).

In each view, a pixel votes for the object of its mask or, if it has none, for the class. The cloud's points collect
these votes. Then each segment takes the label that most of its points have, and votes again: the paper's "Self-training
with Consistency-enhanced Segments" without a rendering in between. A segment whose points agree on no label votes point
by point. So outlines stay those of the masks, and all views together decide what they enclose.

A point that few views see has few votes, and ragged masks leave it with wrong ones, so points share votes with
neighbours on the same thing: most views, weighted by resolution, show both in one segment. So votes do not cross the
outline of a picture or a rug in the plane of its wall or floor. OVSeg3R (arXiv 2509.23541) cuts its superpoints at such
outlines. If views contradict each other, superpoints take the place of neighbours (`superpoints`): a point gets the
other votes of its superpoint. Near views may overrule others on segments that they show as a whole: from afar, a
network takes a sink for the countertop; from nearby, a part of a table for the floor."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..machine.threads import worker_count
from ..presets.preset import EvidenceKind, SegmentVoting
from ..scene import VOID, OnDemand, PanopticMask, Progress, View, evidence, made_ahead, resolution_of, watched
from ..scene.pixels import distinct_ids, numbered_labels
from .agreement import ViewPoints, ViewsOnCloud
from .panoptic_labels import UNKNOWN_LABEL, PanopticLabels, decide_labels

CELLS_AT_A_TIME = 1 << 23
"""Votes of points on labels made dense at once, to bound the memory."""
VIEWS_AT_A_TIME = 32
"""Views whose votes are added at once."""
AGREEMENT = 0.5
"""Minimum fraction of a segment's labelled pixels that must agree for the segment to take their label."""
LEAST_SHARE = 0.1
"""Minimum fraction of its class's votes for an object (see ``decide_labels``)."""


def vote_panoptic_labels(
    seeing: ViewsOnCloud,
    points: int,
    labels: PanopticLabels,
    object_of_segment: Mapping[tuple[str, int], int],
    *,
    options: SegmentVoting,
    kind: EvidenceKind,
    neighbours: Any = None,
    progress: Progress = lambda *_: None,
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the label int32 [N] and the confidence float32 [N] of a cloud's N ``points``. ``object_of_segment``: the
    object, 1 to U, of each mask, by frame and segment id. ``kind``: how views' votes are weighted. ``neighbours``: a
    matrix [N, N] (sparse, or `RestOfSuperpoint`) of the shares in which points also get others' votes, or None."""
    views, point_of_pixel = seeing.views, seeing.point_of_pixel
    some, done = max(1, CELLS_AT_A_TIME // len(labels)), itertools.count(1)
    chosen = [slice(at, at + some) for at in range(0, points, some)]

    def step(*_: int) -> None:
        progress(next(done), (1 + options.rounds) * (len(views) + len(chosen) * (1 + options.near)))

    def decided(maps: Sequence[NDArray[np.int16]]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        votes = _votes(seeing, maps, (points, len(labels)), kind, step)
        shared = votes if neighbours is None else _Votes(*(own + neighbours @ own for own in votes))
        kinds = (shared.asked, shared.near) if options.near else (shared.asked,)
        (label, share), *by_density = made_ahead(kinds, lambda of: _winners(of, labels, watched(chosen, step)))
        for nearer, nearer_share in by_density:  # decide where most come from segments that are seen as a whole
            rows = np.flatnonzero((nearer != label) & (nearer >= 0))
            if len(rows):
                whole, all_ = (np.asarray(of[rows, nearer[rows]]).reshape(-1) for of in (shared.whole, shared.near))
                rows = rows[whole > 0.5 * all_]
                label[rows], share[rows] = nearer[rows], nearer_share[rows]
        return label, share

    label, share = decided(OnDemand(len(views), lambda n: member_labels(views[n], labels, object_of_segment)))
    for _ in range(options.rounds):
        label, share = decided(view_labels(views, point_of_pixel, label, len(labels)))
    return label, share


def view_labels(
    views: Sequence[View], point_of_pixel: Sequence[NDArray[np.int32]], label: NDArray[np.int32], count: int
) -> OnDemand[NDArray[np.int16]]:
    """Return the labels of each view's pixels, int16 [H, W], computed when read: pixels take their points' ``label``
    int32 [N], of ``count`` labels, -1 = unknown, and segments that mostly agree take one label. ``point_of_pixel``
    int32 [H, W] per view, -1 = none."""
    table = np.append(label, UNKNOWN_LABEL)
    return OnDemand(len(views), lambda n: segment_labels(views[n].mask, table[point_of_pixel[n]], count))


def member_labels(
    view: View, labels: PanopticLabels, object_of_segment: Mapping[tuple[str, int], int]
) -> NDArray[np.int16]:
    """Return the label of each pixel of a view's mask, int16 [H, W]: of its segment's object or else its class."""
    present, inverse = numbered_labels(view.mask.ids)
    class_of = {segment.id: segment.class_id for segment in view.mask.segments}
    table = np.full(len(present), UNKNOWN_LABEL, np.int16)
    for index, segment in enumerate(present.tolist()):
        number = object_of_segment.get((view.name, segment), 0)
        table[index] = labels.of_object(number) if number else labels.of_class(class_of.get(segment, VOID))
    return table[inverse.reshape(view.mask.ids.shape)]


def segment_labels(
    mask: PanopticMask, shown: NDArray[np.integer], count: int, agreement: float = AGREEMENT
) -> NDArray[np.int16]:
    """Return the label of each pixel, int16 [H, W]. ``shown`` int [H, W] holds labels from 0 to ``count`` - 1, -1 =
    unknown. If at least the share ``agreement`` of a segment's labelled pixels show one label, the whole segment takes
    it; otherwise its pixels keep their labels. Void is unknown."""
    present, number = numbered_labels(mask.ids)  # ids may be as large as a PNG's colours
    segments, ids = len(present), number.reshape(mask.ids.shape)
    voting = (shown >= 0) & (mask.ids > 0)
    pairs, pixels = distinct_ids(ids[voting].astype(np.int64) * count + shown[voting])
    segment = pairs // count
    total = np.bincount(segment, pixels, segments)
    order = np.lexsort((pairs, -pixels, segment))
    first = np.unique(segment[order], return_index=True)[1]
    best = order[first]
    agreed = pixels[best] >= agreement * total[segment[best]]
    winner = np.full(segments, UNKNOWN_LABEL, np.int16)
    winner[segment[best][agreed]] = (pairs[best] % count)[agreed]
    relabelled = winner[ids]
    kept = np.where(relabelled >= 0, relabelled, shown)
    return np.where(mask.ids > 0, kept, UNKNOWN_LABEL).astype(np.int16)


class _Votes(NamedTuple):
    """Votes on each point's label, sparse float32 [points, labels] each: ``asked``, weighted by the requested kind;
    ``near``, by density of pixels; ``whole``, those of ``near`` by segments that the picture's border does not cut."""

    asked: Any
    near: Any
    whole: Any


def _votes(
    seeing: ViewsOnCloud, maps: Sequence[NDArray[np.int16]], size: tuple[int, int], kind: EvidenceKind, step: Progress
) -> _Votes:
    """Sum the votes of all views; ``maps``: the labels of their pixels; ``size``: the numbers of points and of labels.
    In each view a point's pixels share the view's votes on it."""
    points, count = size

    def of_view(number: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        view, labels, rows = seeing.views[number], maps[number], seeing.point_of_pixel[number]
        seen = rows >= 0
        pixels = np.bincount(rows[seen], minlength=points)
        safe = np.maximum(pixels, 1)
        resolution = np.bincount(rows[seen], resolution_of(view)[seen], points) / safe
        voting = seen & (labels >= 0)
        pairs, index = np.unique(rows[voting].astype(np.int64) * count + labels[voting], return_inverse=True)
        said = view.mask.share_map()
        shown, whole = (
            np.bincount(index.reshape(-1), own[voting], len(pairs)) for own in (said, said * is_whole(view.mask))
        )
        point = pairs // count
        amount = pixels[point] * view.mask_scale**2, resolution[point]
        asked, near = (evidence(each, *amount) / safe[point] for each in (kind, "density"))
        return pairs, np.stack([shown * asked, shown * near, whole * near]).astype(np.float32)

    total = [sparse.csr_matrix((points, count), dtype=np.float32)] * 3
    parts: list[tuple[NDArray[np.int64], NDArray[np.float32]]] = []
    for number, part in enumerate(made_ahead(range(len(seeing.views)), of_view)):
        step(number, len(seeing.views))
        parts.append(part)
        if len(parts) == VIEWS_AT_A_TIME:
            total, parts = _added(total, parts), []
    return _Votes(*_added(total, parts))


def _added(total: list[Any], parts: list[tuple[NDArray[np.int64], NDArray[np.float32]]]) -> list[Any]:
    """Return the sparse matrices ``total`` [points, labels] plus ``parts``; a part has indices point * labels + label,
    int64 [n], and the votes for each matrix, float32 [3, n]."""
    if not parts:
        return total
    cells = np.divmod(np.concatenate([pairs for pairs, _ in parts]), total[0].shape[1])
    votes = np.concatenate([votes for _, votes in parts], axis=1)
    return [all_ + sparse.csr_matrix((own, cells), shape=all_.shape) for all_, own in zip(total, votes, strict=True)]


def is_whole(mask: PanopticMask) -> NDArray[np.bool_]:
    """Return which pixels belong to segments that the picture's border does not cut, bool [H, W]."""
    ids = mask.ids
    return ~np.isin(ids, np.unique(np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])))


def _winners(
    votes: Any, labels: PanopticLabels, slices: Iterable[slice]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the winning label of each point, int32 [N], and its class's share of the votes, float32 [N]."""
    parts = [decide_labels(votes[some].toarray(), labels, LEAST_SHARE) for some in slices]
    return np.concatenate([label for label, _ in parts]), np.concatenate([share for _, share in parts])


NEIGHBOURS = 6
"""Maximum number of a point's neighbours, as in a plane of closely packed cells."""
REACH = 2.0
"""Neighbours are within this many spacings of the cloud."""


def neighbours_on_a_thing(xyz: NDArray[np.floating], spacing: float, seen: Iterable[ViewPoints]) -> Any:
    """Return the weights of each point's neighbours on the same thing, sparse float32 [N, N]; a row sums to 1, or 0
    without neighbours. ``xyz`` [N, 3] and ``spacing``: metres; ``seen``: what each view shows at the points."""
    points, count = np.asarray(xyz, np.float64), len(xyz)
    reach = np.nextafter(REACH * spacing, np.inf)  # the tree's bound excludes the distance itself
    nearest = cKDTree(points).query(points, NEIGHBOURS + 1, distance_upper_bound=reach, workers=worker_count())[1]
    other = nearest[:, 1:]  # without the point itself; N stands for no neighbour
    both, same = np.zeros(other.shape, np.float32), np.zeros(other.shape, np.float32)
    segment, resolution = np.zeros(count + 1, np.int32), np.zeros(count + 1, np.float32)  # the last: no neighbour
    for one in seen:
        segment[one.row], resolution[one.row] = one.segment, one.resolution
        there, here = segment[other[one.row]], one.segment[:, None]
        weight = np.minimum(resolution[other[one.row]], one.resolution[:, None]) * ((there > 0) & (here > 0))
        both[one.row] += weight
        same[one.row] += weight * (there == here)
        segment[one.row] = 0  # clean for the next view, which sees other points
    share = np.where(same > 0.5 * both, same / np.maximum(both, 1e-12), 0.0)
    weight = share / np.maximum(share.sum(1, keepdims=True), 1e-12)
    row, column = np.nonzero(share)
    return sparse.csr_matrix((weight[row, column].astype(np.float32), (row, other[row, column])), (count, count))
