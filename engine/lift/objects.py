"""Finds which masks show the same object, and which points and pixels belong to it. The paper's method is Algorithm 1
on oriented boxes. In ours, masks of several views are joined to objects whatever their classes; then the views vote on
each object's class, segments and points vote on the label of every pixel, and finally the views vote again on the
connected pieces of each object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..instances import objects as by_votes
from ..instances.agreement import ViewPoints, ViewsOnCloud, shown_classes
from ..instances.consensus import ConsensusOptions, FoundObjects, find_objects, with_masks_of
from ..instances.matching import limit_instances, match_views
from ..instances.panoptic_labels import ClassBalance, PanopticLabels
from ..instances.records import ObjectMask, SceneObject, object_of_mask
from ..instances.segment_votes import neighbours_on_a_thing, view_labels, vote_panoptic_labels
from ..instances.segments import SegmentOptions, vote_instances
from ..instances.superpoints import AGREEING, rest_of_superpoints, trusted_superpoints
from ..instances.weak_masks import ViewAgreement, agreement_of_views, class_balance
from ..job.progress import StageProgress
from ..presets.parts import Parts
from ..presets.preset import Preset, ViewEvidence
from ..scene import VOID, ClassTable, OnDemand, Progress, View, made_ahead, stored, watched
from ..semantics.point_cloud import SemanticPointCloud

CONSENSUS = ConsensusOptions()
LARGEST_GAP = 0.15
"""Metres between neighbouring points of one object: about the distance between two pixels of a far view."""


@dataclass(frozen=True, eq=False)
class ViewsToMatch:
    """The input of the matching: the ``views``, their semantic point ``cloud`` and the ``classes``. ``others``: views
    that vote on labels, but whose masks are not joined to objects (not in the paper). ``scratch``: folder for
    arrays."""

    views: Sequence[View]
    cloud: SemanticPointCloud
    classes: ClassTable
    others: Sequence[View] = ()
    scratch: Path | None = None


@dataclass(frozen=True, eq=False)
class Matching:
    """The result of the matching. ``cloud``: with final classes. ``instances``: ids from 1. ``instance_of_point`` int32
    [N], 0 = none. ``dropped``: how many instances were left out. ``label_maps``: each view's panoptic labels, int16 [H,
    W], -1 = unknown; None without votes on pixels. ``point_of_pixel``: index of the cloud's point that each view's
    pixel shows, int32 [H, W], -1 = none; None if not computed. ``masks_agree``: whether the views' masks agree well
    enough to decide where objects end; if not, only points do."""

    cloud: SemanticPointCloud
    instances: list[SceneObject]
    instance_of_point: NDArray[np.int32]
    dropped: int
    label_maps: Sequence[NDArray[np.int16]] | None = None
    point_of_pixel: Sequence[NDArray[np.int32]] | None = None
    masks_agree: bool = True


def instances_by_boxes(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
    """Find instances by the paper's method: Algorithm 1 on the thing segments of all views."""
    views, cloud, classes = given.views, given.cloud, given.classes
    found = match_views(views, classes.thing_ids, segment_options(preset), preset.matching, progress)
    index, reach = cloud.index(), 2 * preset.voxel_size
    owner = vote_instances(
        views, lambda view: index.nearest_of_pixels(view.camera, view.depth, reach), len(cloud), object_of_mask(found)
    )
    owner[~np.isin(cloud.class_id, sorted(classes.thing_ids))] = 0
    instances, instance_of_point, dropped = limit_instances(found, owner, preset.most_instances)
    return Matching(cloud, instances, instance_of_point, dropped)


def segment_options(preset: Preset) -> SegmentOptions:
    """Return the preset's options for turning segments into points before Algorithm 1."""
    shape = preset.segments
    return SegmentOptions(preset.voxel_size, erosion_share=shape.erosion, min_points=shape.least_points)


@dataclass(frozen=True, eq=False)
class VotedThings:
    """The ``things`` that several views agree on. ``training``: the views whose masks were joined to objects;
    ``everyone``: all views that vote, and their detections if masks are weak. ``agreement``: how well the masks agree;
    ``balance``: how much votes for each class count."""

    things: list[SceneObject]
    training: ViewsOnCloud
    everyone: ViewsOnCloud
    agreement: ViewAgreement
    balance: ClassBalance


def objects_by_agreement(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
    """Find instances by our method: join masks on which views agree, vote on each object's class, then let segments and
    points vote on the label of every pixel."""
    found = voted_things(given, preset.evidence, progress)
    part, are_weak = None, found.agreement.is_weak
    may_be_trusted = are_weak or found.agreement.at_least < AGREEING
    if preset.segment_voting.superpoints and may_be_trusted:
        some, kind = given.cloud, preset.evidence.segments
        asked = some.xyz, some.spacing, found.everyone, some.class_ids, kind
        part = trusted_superpoints(*asked, masks_are_weak=are_weak)
    cloud, object_of_point = voted_points(given.cloud, found, part, preset, progress.part(0.4, 0.85))
    owner, things = regrouped(cloud, object_of_point, found, progress.part(0.85, 0.92))
    # A point that lost its object was on the ragged edge of a few masks, so their class is no evidence for it either.
    is_fragment = (object_of_point > 0) & (owner == 0)
    cloud = replace(cloud, class_id=np.where(is_fragment, VOID, cloud.class_id).astype(np.int32))
    owner, things = with_unowned(cloud, owner, things, found.training, given.classes)
    watching = watched(things, progress.part(0.92, 0.95))
    placed = by_votes.placed_objects(found.training.views, watching, cloud.xyz, owner, preset.voxel_size)
    instances, instance_of_point, dropped = limit_instances(placed, owner, preset.most_instances)
    labels, seeing = labels_of(cloud, instances), found.training
    label = labels.of_points(cloud.class_id, instance_of_point)
    shown = view_labels(seeing.views, seeing.point_of_pixel, label, len(labels))
    maps = stored(watched(shown, progress.part(0.95, 1.0)), given.scratch)
    masks_agree = part is None and not are_weak
    return Matching(cloud, instances, instance_of_point, dropped, maps, seeing.point_of_pixel, masks_agree)


def voted_things(given: ViewsToMatch, kinds: ViewEvidence, progress: StageProgress) -> VotedThings:
    """Return the objects that views agree on and vote, by ``kinds`` of votes, to be things. Progress is 0 to 40 %."""
    cloud = given.cloud
    training = on_cloud(given.views, cloud, given.scratch, progress.part(0.0, 0.1))
    training = training.looked_at(progress.part(0.1, 0.15))
    voting = on_cloud(given.others, cloud, given.scratch, progress.part(0.15, 0.2))
    options = replace(CONSENSUS, evidence=kinds.masks)
    found = find_objects(training, len(cloud), options, progress.part(0.2, 0.4))
    everyone, asked = training.and_also(voting), (len(cloud), cloud.class_ids, kinds.segments)
    agreement = agreement_of_views(everyone, *asked)
    if agreement.is_weak:
        voting = voting.and_also(everyone.layers().looked_at(lambda *_: None))
        everyone = training.and_also(voting)
    balance = class_balance(everyone, *asked, agreement)
    found = with_masks_of(found, voting, CONSENSUS.rules)
    things = thing_objects(found, everyone, cloud, given.classes, kinds=kinds, balance=balance)
    return VotedThings(things, training, everyone, agreement, balance)


def voted_points(
    cloud: SemanticPointCloud,
    found: VotedThings,
    superpoint: NDArray[np.int64] | None,
    preset: Preset,
    progress: Progress,
) -> tuple[SemanticPointCloud, NDArray[np.int32]]:
    """Return the cloud with the classes that segments and points vote for, and each point's object, int32 [N], 0 =
    none. Votes are shared within superpoints, ``superpoint`` int64 [N]. Without these, neighbours share them if the
    preset says so."""
    neighbours: Any = None
    if superpoint is not None:
        neighbours = rest_of_superpoints(superpoint, found.agreement.in_all)
    elif preset.segment_voting.neighbours:
        neighbours = neighbours_on_a_thing(cloud.xyz, cloud.spacing, found.training.seen)
    labels = replace(labels_of(cloud, found.things), balance=found.balance)
    members = object_of_mask(found.things)
    label, confidence = vote_panoptic_labels(
        found.everyone, len(cloud), labels, members, options=preset.segment_voting, kind=preset.evidence.segments,
        neighbours=neighbours, progress=progress,
    )  # fmt: skip
    cloud = replace(cloud, class_id=labels.classes(label), confidence=confidence)
    return cloud, labels.objects(label)


def regrouped(
    cloud: SemanticPointCloud, object_of_point: NDArray[np.int32], found: VotedThings, progress: Progress
) -> tuple[NDArray[np.int32], list[SceneObject]]:
    """Let the views vote on each connected piece of the objects. ``object_of_point`` int32 [N]: the number of each
    point's thing in ``found``, 0 = none. Return each point's new object, int32 [N], 0 = none, and the new objects."""
    rules, seeing = by_votes.PieceRules(reach=max(LARGEST_GAP, 3 * cloud.spacing)), found.training
    classes = [one.class_id for one in found.things]
    owner, origin = by_votes.regroup_pieces(
        cloud.xyz, object_of_point, classes, seeing.seen, rules=rules, progress=progress
    )
    masks = masks_of_pieces([mask for one in found.things for mask in one.masks], seeing, owner, len(origin))
    pieces = [SceneObject(number, own, classes[number - 1]) for number, own in zip(origin, masks, strict=True)]
    return without_fragments(owner, pieces, seeing.seen)


def with_unowned(
    cloud: SemanticPointCloud,
    owner: NDArray[np.int32],
    things: list[SceneObject],
    seeing: ViewsOnCloud,
    classes: ClassTable,
) -> tuple[NDArray[np.int32], list[SceneObject]]:
    """Add objects for connected points of a thing's class that belong to no object but that masks show. ``owner`` int32
    [N] is each point's object among ``things``, 0 = none. Return the new owners and the longer list of objects."""
    is_alone = (owner == 0) & np.isin(cloud.class_id, sorted(classes.thing_ids))
    class_of_point = np.where(is_alone, cloud.class_id, VOID).astype(np.int32)
    rules = by_votes.PieceRules(reach=max(LARGEST_GAP, 3 * cloud.spacing), fragment=0.0)
    taken = object_of_mask(things)
    piece, found = by_votes.unowned_pieces(
        cloud.xyz, class_of_point, seeing.views, seeing.seen, taken=taken, rules=rules
    )
    joined = [*things, *(replace(one, id=len(things) + one.id) for one in found)]
    return np.where(piece > 0, piece + len(things), owner).astype(np.int32), joined


def labels_of(cloud: SemanticPointCloud, objects: Sequence[SceneObject]) -> PanopticLabels:
    """Return the numbering of panoptic labels for the cloud's classes and for these objects."""
    return PanopticLabels(cloud.class_ids, tuple(one.class_id for one in objects))


def on_cloud(
    views: Sequence[View], cloud: SemanticPointCloud, scratch: Path | None, progress: Progress
) -> ViewsOnCloud:
    """Find what each view sees of the cloud; ``scratch`` is a folder for temporary files."""
    return ViewsOnCloud.of(views, point_of_pixels(watched(views, progress), cloud, scratch))


def point_of_pixels(
    views: Sequence[View], cloud: SemanticPointCloud, scratch: Path | None
) -> OnDemand[NDArray[np.int32]]:
    """Return, for each view, the index of the cloud's point that every pixel shows, int32 [H, W], -1 = none. The arrays
    are stored in temporary files in ``scratch``."""
    index, reach = cloud.index(), 2 * cloud.spacing
    rows = made_ahead(views, lambda view: index.nearest_of_pixels(view.camera, view.depth, reach))
    return stored(rows, scratch)


def no_objects(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
    """Return no instances at all: linear assignment then learns instances during training."""
    return Matching(given.cloud, [], np.zeros(len(given.cloud), np.int32), 0)


Matcher = Callable[[ViewsToMatch, Preset, StageProgress], Matching]
MATCHERS: Parts[Matcher] = Parts(
    "matcher", {"boxes": instances_by_boxes, "agreement": objects_by_agreement, "none": no_objects}
)
"""The functions that match, by the preset's ``objects``."""


def register_matcher(name: str, matcher: Matcher) -> None:
    """Make a matcher available, in this process, to presets that give this name in ``objects``."""
    MATCHERS.register(name, matcher)


def thing_objects(
    found: FoundObjects,
    seeing: ViewsOnCloud,
    cloud: SemanticPointCloud,
    classes: ClassTable,
    *,
    kinds: ViewEvidence,
    balance: ClassBalance,
) -> list[SceneObject]:
    """Return those of the ``found`` objects that the views in ``seeing`` vote to be things, with new ids from 1. Votes
    are of ``kinds``, and classes are weighted by ``balance``."""
    shown = [(seen, shown_classes(view, seen)) for view, seen in zip(seeing.views, seeing.seen, strict=True)]
    asked = found.object_of_point, len(found.objects), cloud.class_ids
    votes = by_votes.vote_classes(shown, *asked, kinds.objects)
    is_one = by_votes.held_back_agreement(shown, *asked, kinds=kinds, frames=seeing.by_frame())
    class_of_object = by_votes.object_classes(votes, cloud.class_ids, is_one, balance).tolist()
    things = (one for one in found.objects if class_of_object[one.id] in classes.thing_ids)
    return [replace(one, id=number, class_id=class_of_object[one.id]) for number, one in enumerate(things, start=1)]


def masks_of_pieces(
    masks: Sequence[ObjectMask], seeing: ViewsOnCloud, owner: NDArray[np.int32], count: int
) -> list[tuple[ObjectMask, ...]]:
    """Return the masks of each of ``count`` pieces, in the order of the views. A mask counts for the piece with most of
    its points, unless its view only votes. ``owner`` int32 [N]: each point's piece, from 1, 0 = none."""
    number_of = {view.name: number for number, view in enumerate(seeing.views)}
    members: list[list[ObjectMask]] = [[] for _ in range(count)]
    own = (mask for mask in masks if mask.frame in number_of)
    for mask in sorted(own, key=lambda each: number_of[each.frame]):
        seen = seeing.seen[number_of[mask.frame]]
        owned = np.bincount(owner[seen.row[seen.segment == mask.segment.id]], minlength=count + 1)
        owned[0] = 0  # no piece
        if owned.any():
            members[int(owned.argmax()) - 1].append(mask)
    return [tuple(each) for each in members]


def without_fragments(
    owner: NDArray[np.int32], pieces: Sequence[SceneObject], seen: Sequence[ViewPoints]
) -> tuple[NDArray[np.int32], list[SceneObject]]:
    """Keep the pieces that enough masks show. Return each point's object, int32 [N], 0 = none, and the kept pieces,
    with ids from 1. A piece needs as many masks as an object that the same views see. If its object was split, it needs
    as many as an object that all views see; a piece with fewer is the ragged edge of a few masks. ``seen``: what each
    view shows. ``owner`` int32 [N]: each point's piece, from 1, 0 = none; a piece's ``id`` is the id of the object that
    it was part of."""
    parts, size = Counter(one.id for one in pieces), np.bincount(owner, minlength=len(pieces) + 1)
    shares = (np.bincount(owner[one.row], minlength=len(size)) / np.maximum(size, 1) for one in seen)
    seeing = sum((share >= 0.5 for share in shares), np.zeros(len(size), np.int64))[1:]
    seeing[[parts[one.id] > 1 for one in pieces]] = len(seen)
    kept = [n for n, one in enumerate(pieces) if len(one.masks) >= CONSENSUS.least_masks(int(seeing[n]))]
    number = np.zeros(len(pieces) + 1, np.int32)
    number[[index + 1 for index in kept]] = np.arange(1, len(kept) + 1)
    return number[owner], [replace(pieces[index], id=new) for new, index in enumerate(kept, start=1)]
