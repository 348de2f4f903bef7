"""Finishes the objects that views agree on: votes on the class of each, finds its points and box, and divides it into
connected pieces that may form other objects.

The class vote is ours, beyond the paper. A detector is wrong about a whole object in a view (takes the sofa for a bed)
far more often than about single pixels, so all points of an object get one class. Views that resolve the object better
have more votes.

Clustering masks can put two separate things into one object, or leave one thing in two objects if it was seen from both
ends of a room. So the views vote again, on connected pieces of points instead of masks: a view that sees enough of two
pieces shows them inside one mask, or does not."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..presets.preset import EvidenceKind, ViewEvidence
from ..scene import Progress, View, evidence, made_ahead, watched
from .agreement import ViewPoints
from .panoptic_labels import UNBALANCED, ClassBalance
from .records import ObjectMask, SceneObject, fit_box

LEAST_SHARE = 0.4
"""Minimum fraction of an object's votes for its class. Masks that share a position but no class are not one object:
usually they belong to several things that a network could not distinguish."""
LEAST_VIEWS = 2
"""Views that must have a mask on a piece of a thing that no object owns, so that it becomes an object."""


def vote_classes(
    views: Iterable[tuple[ViewPoints, NDArray[np.int32]]],
    object_of_point: NDArray[np.int32],
    objects: int,
    class_ids: tuple[int, ...],
    kind: EvidenceKind,
) -> NDArray[np.float64]:
    """Return the votes on the class of each object, float64 [objects + 1, C]; row 0 (no object) is all 0. ``views``:
    what each view shows at the points it sees, and its class for each, int32 [n], 0 = none. ``object_of_point`` int32
    [N], 0 = none. The pixels of an object in a view share the view's votes, whose number depends on ``kind``."""
    ids = np.asarray(class_ids)
    votes = np.zeros((objects + 1, len(ids)))
    for view, shown in views:
        column = np.minimum(np.searchsorted(ids, shown), len(ids) - 1)
        owner = object_of_point[view.row]
        voting = (owner > 0) & (ids[column] == shown)
        owner, column, pixels = owner[voting], column[voting], view.pixels[voting]
        seen = np.bincount(owner * len(ids) + column, pixels, votes.size).reshape(votes.shape)
        whole = np.maximum(seen.sum(1), 1e-12)
        resolution = np.bincount(owner, pixels * view.resolution[voting], len(votes)) / whole
        said = np.bincount(owner * len(ids) + column, pixels * view.shares[voting], votes.size).reshape(votes.shape)
        votes += said * (evidence(kind, whole, resolution) / whole)[:, None]
    return votes


def object_classes(
    votes: NDArray[np.float64],
    class_ids: tuple[int, ...],
    is_one: NDArray[np.bool_],
    balance: ClassBalance = UNBALANCED,
) -> NDArray[np.int32]:
    """Return each object's class, int32 [objects + 1], row 0 for no object: that of ``class_ids`` [C] with the most
    ``votes`` [objects + 1, C], weighted by ``balance``; ties go to the lower id. It is 0 without votes, and if the
    winner has less than ``LEAST_SHARE`` of them, unless ``is_one`` bool [objects + 1] says that it is one."""
    votes = balance.of(votes)
    winner = np.asarray(class_ids, np.int32)[votes.argmax(1)]
    is_agreed = (votes.max(1) >= LEAST_SHARE * votes.sum(1)) | is_one
    return np.where(votes.any(1) & is_agreed, winner, 0).astype(np.int32)


def held_back_agreement(
    views: Sequence[tuple[ViewPoints, NDArray[np.int32]]],
    object_of_point: NDArray[np.int32],
    objects: int,
    class_ids: tuple[int, ...],
    *,
    kinds: ViewEvidence,
    frames: Sequence[Sequence[int]],
) -> NDArray[np.bool_]:
    """Return whether one class describes each object at least as well as a class per point, bool [objects + 1]. Each of
    ``frames`` (the indices of its views) is held back in turn, and what it shows is compared with the object's class,
    and with each point's class, as the other frames vote. ``views``, ``object_of_point`` and ``class_ids`` are as in
    `vote_classes`; ``kinds`` say how views' votes count."""
    ids, (points, classes, count) = np.asarray(class_ids), (len(object_of_point), len(class_ids), objects + 1)
    of_points, of_objects = np.zeros((points, classes)), np.zeros((count, classes))  # float64: residues must be 0
    said = []
    for view, shown in views:
        column = np.minimum(np.searchsorted(ids, shown), classes - 1)
        voting = (ids[column] == shown) & (object_of_point[view.row] > 0)
        row, column, pixels = view.row[voting], column[voting], view.pixels[voting].astype(np.float64)
        weight = evidence(kinds.segments, pixels, view.resolution[voting]).astype(np.float32) * view.shares[voting]
        of_points[row, column] += weight  # a view has each point once
        owner = object_of_point[row]
        whole = np.maximum(np.bincount(owner, pixels, count), 1e-12)
        resolution = np.bincount(owner, pixels * view.resolution[voting], count) / whole
        share = pixels * (evidence(kinds.objects, whole, resolution) / whole)[owner] * view.shares[voting]
        own = np.bincount(owner * classes + column, share, count * classes).reshape(count, classes)
        of_objects += own
        said.append((row, column, owner, weight, share, own))

    def without(numbers: Sequence[int]) -> NDArray[np.float64]:
        row, column, owner, weight, share = (np.concatenate([said[n][k] for n in numbers]) for k in range(5))
        rest = of_objects - sum(said[n][5] for n in numbers)
        one = np.where(rest.max(1) > 1e-9, rest.argmax(1), -1)[owner]
        seen, at = np.unique(row, return_inverse=True)
        others = of_points[seen]
        np.subtract.at(others, (at, column), weight)
        each = np.where(others.max(1, initial=0) > 1e-6, others.argmax(1), -1)[at]
        each = np.where(each >= 0, each, one)
        return np.stack([np.bincount(owner, share * (column == shown), count) for shown in (one, each)])

    as_one, as_points = sum(made_ahead(frames, without), np.zeros((2, count)))
    return as_one >= as_points


def placed_objects(
    views: Sequence[View],
    objects: Sequence[SceneObject],
    xyz: NDArray[np.floating],
    object_of_point: NDArray[np.int32],
    min_thickness: float,
) -> list[SceneObject]:
    """Return the objects with their points, boxes, and the pixel counts of their masks; each must have points. ``xyz``
    [N, 3]: the cloud's points, metres; ``object_of_point`` int32 [N]: each point's object, 0 = none; ``min_thickness``:
    the shortest side of a box, metres."""
    pixels = {
        (view.name, int(segment)): int(count)
        for view in views
        for segment, count in zip(*np.unique(view.mask.ids[view.depth > 0], return_counts=True), strict=True)
    }
    placed = []
    for one in objects:
        points = np.asarray(xyz[object_of_point == one.id], np.float64)
        masks = tuple(replace(mask, pixels=pixels.get(mask.key, 0)) for mask in one.masks)
        placed.append(replace(one, points=points, box=fit_box(points, min_thickness), masks=masks))
    return placed


@dataclass(frozen=True)
class PieceRules:
    """Points nearer than ``reach`` metres are connected. A piece of fewer than ``min_points`` points, or less than the
    share ``fragment`` of its object's largest piece, is a fragment, such as a mask's ragged edge on the wall behind. A
    view judges a piece if it sees ``min_points`` of it, with the share ``contained`` of these in one mask. Pieces of an
    object stay together if at least the share ``stay`` of the views that judge both join them. Touching pieces of two
    objects of a class become one object if at least the share ``join`` of these views, at least two, join them."""

    reach: float = 0.15
    min_points: int = 5
    fragment: float = 0.1
    contained: float = 0.7
    stay: float = 0.3
    join: float = 0.6


def regroup_pieces(
    xyz: NDArray[np.floating],
    object_of_point: NDArray[np.int32],
    class_of_object: Sequence[int],
    summaries: Sequence[ViewPoints],
    *,
    rules: PieceRules,
    progress: Progress = lambda *_: None,
) -> tuple[NDArray[np.int32], list[int]]:
    """Let the views vote on connected pieces of objects. Return each point's new object, int32 [N], from 1 (0 = none),
    and for each new object the old object of its largest piece. ``xyz`` [N, 3], metres; ``object_of_point`` int32 [N],
    0 = none; ``class_of_object``: the class of objects 1, 2, ...; ``summaries``: what each view shows at the points."""
    piece, owner = _pieces(xyz, object_of_point, rules, progress)
    if not len(owner):
        return np.zeros(len(xyz), np.int32), []
    joined, judged = _views_on_pairs(piece, len(owner), summaries, rules)
    same_object = owner[:, None] == owner[None]
    share = joined / np.maximum(judged, 1)
    together = same_object & (judged > 0) & (share >= rules.stay)
    kind = np.asarray(class_of_object)[owner - 1]
    merge = ~same_object & (kind[:, None] == kind[None]) & (joined >= 2) & (share >= rules.join)
    rows = np.flatnonzero(piece >= 0)
    pairs = cKDTree(np.asarray(xyz[rows], np.float64)).query_pairs(rules.reach, output_type="ndarray")
    touching = np.zeros((len(owner), len(owner)), bool)
    touching[piece[rows[pairs[:, 0]]], piece[rows[pairs[:, 1]]]] = True
    merge &= touching | touching.T
    count, group = connected_components(coo_matrix(together | merge), directed=False)
    # A group belongs to the object of its largest piece.
    size = np.bincount(piece[piece >= 0], minlength=len(owner))
    origin = [int(owner[group == number][size[group == number].argmax()]) for number in range(count)]
    order = np.argsort(origin, kind="stable")
    number_of_group = np.empty(count, np.int32)
    number_of_group[order] = np.arange(1, count + 1)
    table = np.append(number_of_group[group], 0).astype(np.int32)  # the last entry is for piece -1, none
    return table[piece], [origin[each] for each in order]


def unowned_pieces(
    xyz: NDArray[np.floating],
    class_of_point: NDArray[np.int32],
    views: Sequence[View],
    summaries: Sequence[ViewPoints],
    *,
    taken: Container[tuple[str, int]],
    rules: PieceRules,
) -> tuple[NDArray[np.int32], list[SceneObject]]:
    """Make objects of connected points of one class, where at least LEAST_VIEWS views have a mask of it. Return each
    point's object, int32 [N], 0 = none, and the objects, with ids from 1. ``class_of_point`` int32 [N]: 0 for points to
    leave out; ``taken``: keys of masks that belong to other objects; ``summaries``: what each view shows at the points.
    A mask goes to the piece with most of its points."""
    piece, class_of_piece = _pieces(xyz, class_of_point, rules, lambda *_: None)
    masks: list[list[ObjectMask]] = [[] for _ in class_of_piece]
    for view, seen in zip(views, summaries, strict=True):
        for segment in view.mask.segments:
            own = piece[seen.row[seen.segment == segment.id]]
            own = own[own >= 0]
            own = own[class_of_piece[own] == segment.class_id]
            if len(own) >= rules.min_points and (view.name, segment.id) not in taken:
                masks[int(np.bincount(own).argmax())].append(ObjectMask(view.name, segment))
    kept = [number for number, own in enumerate(masks) if len({mask.frame for mask in own}) >= LEAST_VIEWS]
    number_of = np.zeros(len(masks) + 1, np.int32)  # the last is for piece -1, none
    number_of[kept] = np.arange(1, len(kept) + 1)
    found = [SceneObject(new, tuple(masks[old]), int(class_of_piece[old])) for new, old in enumerate(kept, start=1)]
    return number_of[piece], found


def _pieces(
    xyz: NDArray[np.floating], object_of_point: NDArray[np.int32], rules: PieceRules, progress: Progress
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return each point's connected piece, int64 [N], -1 = none or a fragment, and each piece's object, int64 [P]."""
    piece = np.full(len(xyz), -1, np.int64)
    owner: list[int] = []
    for number in watched(range(1, int(object_of_point.max(initial=0)) + 1), progress):
        rows = np.flatnonzero(object_of_point == number)
        if len(rows) < rules.min_points:
            continue
        pairs = cKDTree(np.asarray(xyz[rows], np.float64)).query_pairs(rules.reach, output_type="ndarray")
        graph = coo_matrix((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(len(rows), len(rows)))
        part = connected_components(graph, directed=False)[1]
        size = np.bincount(part)
        for each in np.flatnonzero(size >= max(rules.min_points, rules.fragment * size.max())):
            piece[rows[part == each]] = len(owner)
            owner.append(number)
    return piece, np.array(owner, np.int64)


def _views_on_pairs(
    piece: NDArray[np.int64], pieces: int, summaries: Sequence[ViewPoints], rules: PieceRules
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how many views show each two pieces inside one mask, and how many judge both; float64 [P, P] each."""
    joined, judged = np.zeros((pieces, pieces)), np.zeros((pieces, pieces))
    for summary in summaries:
        shown = piece[summary.row]
        voting = (shown >= 0) & (summary.segment > 0)
        segments, column = np.unique(summary.segment[voting], return_inverse=True)
        if not len(segments):
            continue
        cells = np.bincount(shown[voting] * len(segments) + column.reshape(-1), minlength=pieces * len(segments))
        cells = cells.reshape(pieces, len(segments))
        seen, most = cells.sum(1), cells.max(1)
        judges = np.flatnonzero((seen >= rules.min_points) & (most >= rules.contained * seen))
        mask = cells[judges].argmax(1)
        judged[np.ix_(judges, judges)] += 1
        joined[np.ix_(judges, judges)] += mask[:, None] == mask[None]
    return joined, judged
