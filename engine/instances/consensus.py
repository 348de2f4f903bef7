"""Finds which masks show the same object, by the agreement of views (ours, beyond the paper). Boxes cannot tell a chair
from the table above it. Here two masks are joined if most views that see the surface of both show it inside one mask,
whatever its class. So a view that merges or splits objects is outvoted, and a class that changes from view to view does
no harm. The idea is the view consensus of MaskClustering (Yan et al., CVPR 2024), with sums in place of its schedule of
thresholds. Of a long scan, only keyframes' masks are joined."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..presets.preset import EvidenceKind
from ..scene import Progress, watched
from . import agreement
from .agreement import Agreement, JudgingRules, MasksInSpace, ViewsOnCloud
from .records import ObjectMask, SceneObject


@dataclass(frozen=True)
class ConsensusOptions:
    """Masks are joined if more than the share ``agreement`` of the views that judge both (by ``rules``) are in favour.
    An object needs masks in the share ``support`` of the views that see half of its points, and at least ``min_masks``.
    If few views see it, masks in all views but one are enough (at least 2), if their mean agreement is ``sure``. If
    there are more than ``most_masks`` masks, only those of keyframes are joined; any other goes to the object with most
    of its points. A tracker counts as ``tracker`` views on each pair of masks that it followed, in favour if it gave
    both the same track. ``evidence``: how views' votes are weighted."""

    rules: JudgingRules = JudgingRules()
    agreement: float = 0.35
    min_masks: int = 3
    sure: float = 0.6
    support: float = 0.1
    most_masks: int = 4000
    tracker: float = 1.0
    evidence: EvidenceKind = "views"

    def least_masks(self, seeing: int) -> int:
        """Return how many masks an object needs if ``seeing`` views see it."""
        return min(self.min_masks, max(2, seeing - 1))


@dataclass(frozen=True, eq=False)
class FoundObjects:
    """The ``objects``, with ids from 1, and the object of each point, ``object_of_point`` int32 [N], 0 = none."""

    object_of_point: NDArray[np.int32]
    objects: list[SceneObject]


def find_objects(
    seeing: ViewsOnCloud, points: int, options: ConsensusOptions, progress: Progress = lambda *_: None
) -> FoundObjects:
    """Return the objects on which the views in ``seeing`` agree, in a cloud of ``points`` points."""
    space = agreement.masks_in_space(seeing, points, options.rules.min_points, options.evidence)
    keyframes = choose_keyframes(space, options.most_masks)
    found = objects_of_masks(space.of_views(keyframes), options, progress)
    return with_masks_of(found, seeing.only(np.setdiff1d(np.arange(len(seeing.views)), keyframes)), options.rules)


def with_masks_of(found: FoundObjects, others: ViewsOnCloud, rules: JudgingRules) -> FoundObjects:
    """Add the masks of ``others``, views whose masks were not joined, each to the object that has at least the share
    ``contained`` (of ``rules``) of its points."""
    masks = [list(one.masks) for one in found.objects]
    for view, seen in zip(others.views, others.seen, strict=True):
        for segment, rows in agreement.masks_of_view(view, seen, rules.min_points):
            owned = np.bincount(found.object_of_point[rows], minlength=1)
            owned[0] = 0  # no object
            number = int(owned.argmax())
            if number and owned[number] >= rules.contained * len(rows):
                masks[number - 1].append(ObjectMask(view.name, segment))
    objects = [replace(one, masks=tuple(own)) for one, own in zip(found.objects, masks, strict=True)]
    return FoundObjects(found.object_of_point, objects)


def objects_of_masks(
    space: MasksInSpace, options: ConsensusOptions, progress: Progress = lambda *_: None
) -> FoundObjects:
    """Cluster all masks into objects; each point goes to the object whose masks have the most votes there."""
    points = space.holds.shape[1]
    nothing = FoundObjects(np.zeros(points, np.int32), [])
    if not space.masks:
        return nothing
    judgement, sound = agreement.judge_masks(space, options.rules)
    rows = np.flatnonzero(sound)
    cluster = join_agreeing(space, judgement, rows, options, lambda done, all_: progress(done, 3 * all_))
    members = [rows[cluster == name] for name in np.unique(cluster)]
    watching = watched(members, lambda done, all_: progress(all_ + done, 3 * all_))
    members = [each for each in watching if _is_supported(space, judgement, each, options)]
    if not members:
        return nothing
    owner = np.zeros(points, np.int32)
    most: NDArray[np.floating] = np.zeros(points)
    found: list[SceneObject] = []
    for number, each in enumerate(members, start=1):  # not in one array: thousands of objects have millions of points
        progress(2 * len(members) + number, 3 * len(members))
        votes = np.asarray(space.votes_in(each).sum(0)).reshape(-1)
        more = votes > most
        owner[more], most[more] = number, votes[more]
        shares = agreements(*pairwise(judgement, each))
        masks = (replace(space.masks[row], agreement=share) for row, share in zip(each, shares, strict=True))
        found.append(SceneObject(len(found) + 1, tuple(masks)))
    return FoundObjects(owner, found)


def join_agreeing(
    space: MasksInSpace,
    judgement: Agreement,
    rows: NDArray[np.intp],
    options: ConsensusOptions,
    progress: Progress = lambda *_: None,
) -> NDArray[np.int64]:
    """Cluster the masks with the indices ``rows``. Return each one's cluster, int64 [R]: the lowest position in
    ``rows``. Only masks linked by a chain of positive weights are ever joined, so each linked part is clustered
    separately, and no array of all masks by all masks is needed."""
    part = linked_parts(space, judgement, rows, options)
    cluster = np.arange(len(rows))
    order = np.argsort(part, kind="stable")
    joins = itertools.count()  # of M masks there are fewer
    for own in np.split(order, np.cumsum(np.bincount(part))[:-1]):
        if len(own) > 1:
            weight = join_weight(space, judgement, rows[own], options)
            cluster[own] = own[join(weight, lambda: progress(next(joins), len(rows)))]
    return cluster


def join_weight(
    space: MasksInSpace, judgement: Agreement, rows: NDArray[np.intp], options: ConsensusOptions
) -> NDArray[np.float32]:
    """Return how much speaks for joining two of the masks ``rows``, float32 [R, R]: the views in favour, less the share
    ``agreement`` of those that judge both; a tracker counts as further views."""
    favour, judging = pairwise(judgement, rows)
    weight: NDArray[np.float32] = favour - options.agreement * judging
    if has_tracks(space):
        same, followed = tracked(space, rows)
        weight += options.tracker * (same - options.agreement * followed)
    return weight


def join(weight: NDArray[np.floating], step: Callable[[], object] = lambda: None) -> NDArray[np.int64]:
    """Cluster rows greedily: join the two clusters with the largest sum of ``weight`` (symmetric [M, M]) while it is
    positive; ties go to the lower rows. Return each row's cluster, int64 [M]: the lowest of its rows. Calls ``step``
    before each join."""
    weight = np.array(weight, np.float64)
    np.fill_diagonal(weight, -np.inf)
    cluster = np.arange(len(weight))
    partner = weight.argmax(1)
    best = weight[cluster, partner] if len(weight) else np.zeros(0)
    while len(weight):
        step()
        i = int(best.argmax())
        if best[i] <= 1e-9:  # less may be the rounding of sums
            break
        i, j = sorted((i, int(partner[i])))
        cluster[cluster == j] = i
        joined = weight[i] + weight[j]
        weight[i], weight[:, i] = joined, joined
        weight[j], weight[:, j] = -np.inf, -np.inf
        best[j] = -np.inf
        # Rows whose partner was i or j search again; the others only need to compare with the new i.
        for row in np.flatnonzero((partner == i) | (partner == j) | (np.arange(len(weight)) == i)):
            partner[row] = weight[row].argmax()
            best[row] = weight[row, partner[row]]
        better = (joined > best) | ((joined == best) & (i < partner))
        better[[i, j]] = False  # i has just searched, and j is gone
        partner[better], best[better] = i, joined[better]
    return cluster


def linked_parts(
    space: MasksInSpace, judgement: Agreement, rows: NDArray[np.intp], options: ConsensusOptions
) -> NDArray[np.int32]:
    """Return the part of each of the masks ``rows``, int32 [R]; no `join_weight` of two parts' masks is positive."""
    inside = judgement.inside[rows]
    judges = judgement.judges[np.ix_(rows, judgement.judges.any(0))]  # without views that judge nothing
    favour = (inside @ inside.T).tocoo()
    row, column = favour.row, favour.col
    judging = np.empty(len(row), np.float32)
    for start in range(0, len(row), agreement.PAIRS_AT_A_TIME):
        some = slice(start, start + agreement.PAIRS_AT_A_TIME)
        judging[some] = np.einsum("pv,pv->p", judges[row[some]], judges[column[some]])
    most = options.tracker if has_tracks(space) else 0.0  # what the tracker may add to a pair
    linked = favour.data + most > options.agreement * judging
    track = tracks_of(space, rows)
    order = np.argsort(track, kind="stable")
    chained = (track[order[1:]] == track[order[:-1]]) & (track[order[1:]] >= 0)  # neighbours: enough to link a track
    one, other = order[:-1][chained], order[1:][chained]
    ends = np.concatenate([row[linked], one]), np.concatenate([column[linked], other])
    graph = coo_matrix((np.ones(len(ends[0]), bool), ends), favour.shape)
    part: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return part


def has_tracks(space: MasksInSpace) -> bool:
    """Whether any of the masks has a track, an id that a tracker followed over frames."""
    return any(mask.segment.track is not None for mask in space.masks)


def tracks_of(space: MasksInSpace, rows: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the track of each of the masks ``rows``, int64 [R], -1 = none."""
    tracks = (space.masks[row].segment.track for row in rows)
    return np.array([-1 if track is None else track for track in tracks], np.int64)


def pairwise(judgement: Agreement, rows: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return two float32 [R, R], for each pair of the masks ``rows``: how many views show both inside one mask, and how
    many judge both. Views are weighted by `Agreement.judges`."""
    inside = judgement.inside[rows]
    judges = judgement.judges[rows]
    return (inside @ inside.T).toarray(), judges @ judges.T


def tracked(space: MasksInSpace, rows: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return which pairs of the masks ``rows`` have the same track, and which have tracks at all; 0/1 float32 [R, R]
    each. Pairs in one view are left out, as a track occurs only once in a frame."""
    track = tracks_of(space, rows)
    view = space.view[rows]
    followed = (track[:, None] >= 0) & (track[None, :] >= 0) & (view[:, None] != view[None, :])
    same = followed & (track[:, None] == track[None, :])
    return same.astype(np.float32), followed.astype(np.float32)


def _is_supported(
    space: MasksInSpace, judgement: Agreement, members: NDArray[np.intp], options: ConsensusOptions
) -> bool:
    """Whether enough of the views that see the object have a mask of it and, if there are few masks, agree on it. Views
    count by how well they resolve the object, compared with those that have the masks."""
    own = (np.asarray(space.holds[members].sum(0)).reshape(-1) > 0).astype(np.float32)
    seen = space.sight @ own
    masking = np.unique(space.view[members])
    resolved = space.weight @ own / np.maximum(seen, 1)
    resolved = np.minimum(resolved / resolved[masking].mean(), 1.0)
    seeing = float(resolved[seen >= 0.5 * own.sum()].sum())
    if len(masking) < options.least_masks(int(seeing)) or resolved[masking].sum() < options.support * seeing:
        return False
    if len(masking) >= options.min_masks:
        return True
    shares = [share for share in agreements(*pairwise(judgement, members)) if share is not None]
    return bool(shares) and float(np.mean(shares)) >= options.sure


def agreements(favour: NDArray[np.floating], judging: NDArray[np.floating]) -> list[float | None]:
    """Return, for each of an object's m masks, the share of views' judgements that join it with another mask; None for
    a mask that no view judges. ``judging`` [m, m]: how many views judge a pair; ``favour`` [m, m]: how many join it."""
    judged = judging.sum(1) - np.diag(judging)
    agreed = favour.sum(1) - np.diag(favour)
    return [float(yes) / float(all_) if all_ > 0 else None for yes, all_ in zip(agreed, judged, strict=True)]


SIGHTINGS = 5
"""How many keyframes should see each point, if as many views see it at all."""
WORTH_IT = 0.25
"""A view is added when more than this share of its points are seen by too few keyframes."""


def choose_keyframes(space: MasksInSpace, most_masks: int) -> NDArray[np.int64]:
    """Return the indices of the views whose masks to join, ascending: all views, if they have at most ``most_masks``
    masks. Otherwise views are chosen evenly, and any view without which surfaces would be seen too rarely is added, so
    there may be slightly more masks."""
    views = space.sight.shape[0]
    if len(space.masks) <= most_masks:
        return np.arange(views)
    wanted = max(1, views * most_masks // len(space.masks))
    chosen = np.zeros(views, bool)
    chosen[np.linspace(0, views - 1, wanted).round().astype(np.int64)] = True
    seen = np.asarray(space.sight.sum(0)).reshape(-1)
    sighted = np.asarray(space.sight[chosen].sum(0)).reshape(-1)
    # One sighting at a time. If all were required at once, they would all come from the first views of a surface.
    for wanted in range(1, SIGHTINGS + 1):
        lacking = np.minimum(seen, wanted) - sighted
        for view in np.flatnonzero(~chosen):
            points = space.sight[view].indices
            if len(points) and (lacking[points] > 0).mean() > WORTH_IT:
                chosen[view] = True
                lacking[points] -= 1
                sighted[points] += 1
    return np.flatnonzero(chosen)
