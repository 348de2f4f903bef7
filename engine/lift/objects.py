"""Which masks are one object, and which points and pixels belong to it.

The paper's way is Algorithm 1 on oriented boxes. In ours, the views agree on objects, whatever they call them. Then
they vote on each object's class, and segments and points vote on what every pixel shows. Last, the views decide again
about the connected pieces of each object.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..instances.agreement import ViewPoints, shown_classes
from ..instances.consensus import ConsensusOptions, MemberMask, ObjectMasks, find_objects, with_masks_of
from ..instances.masks import vote_instances
from ..instances.matching import GlobalInstance, limit_instances, match_views
from ..instances.objects import object_classes, object_instances, vote_classes
from ..instances.panoptic_labels import PanopticLabels
from ..instances.pieces import PieceRules, regroup_pieces
from ..instances.segment_votes import view_labels, vote_panoptic_labels
from ..instances.segments import SegmentOptions
from ..presets.preset import EvidenceKind, Preset
from ..scene import VOID, ClassTable, OnDemand, View, chained, stored
from ..semantics.point_cloud import SemanticPointCloud
from ..train.progress import StageProgress
from .voters import Voters

CONSENSUS = ConsensusOptions()
LARGEST_GAP = 0.15
"""Metres between neighbouring points of one object: about the distance of two pixels of a far view."""


@dataclass(frozen=True, eq=False)
class ViewsToMatch:
    """What instances are matched from: the ``views``, their semantic ``cloud`` and the ``classes``. ``others`` are
    views that vote, but are not asked which masks are one object; the paper's way has no use for them. ``scratch`` is
    the folder for temporary files."""

    views: Sequence[View]
    cloud: SemanticPointCloud
    classes: ClassTable
    others: Sequence[View] = ()
    scratch: Path | None = None


@dataclass(frozen=True, eq=False)
class Matching:
    """The ``cloud`` with its final classes, the ``instances`` with ids 1.., the instance of each point int32 [N] (0 =
    none), and how many more instances were ``dropped``. ``label_maps`` are those of ``PreparedLift``.
    ``point_of_pixel``: the point of the cloud that each pixel of the views shows, int32 [H, W] (-1 = none), where it
    was looked up."""

    cloud: SemanticPointCloud
    instances: list[GlobalInstance]
    instance_of_point: NDArray[np.int32]
    dropped: int
    label_maps: Sequence[NDArray[np.int16]] | None = None
    point_of_pixel: Sequence[NDArray[np.int32]] | None = None


def instances_by_boxes(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
    """The paper's way: Algorithm 1 on the thing segments of all views."""
    views, cloud, classes = given.views, given.cloud, given.classes
    segments = SegmentOptions(voxel_size=preset.voxel_size)
    found = match_views(views, classes.thing_ids, segments, preset.matching, progress)
    owner_of_segment = {(item.frame, item.segment_id): one.id for one in found for item in one.evidence}
    index, reach = cloud.index(), 2 * preset.voxel_size
    owner = vote_instances(
        views, lambda view: index.nearest_of_pixels(view.camera, view.depth, reach), len(cloud), owner_of_segment
    )
    owner[~np.isin(cloud.class_id, sorted(classes.thing_ids))] = 0
    instances, instance_of_point, dropped = limit_instances(found, owner, preset.most_instances)
    return Matching(cloud, instances, instance_of_point, dropped)


def objects_by_agreement(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
    """Ours: objects that the views agree on, the class that they vote for each, and the labels that segments and points
    vote for every pixel."""
    views, cloud, scratch = given.views, given.cloud, given.scratch
    rows, consensus = point_of_pixels(views, cloud, scratch), replace(CONSENSUS, evidence=preset.evidence.masks)
    voters = Voters(given.others, point_of_pixels(given.others, cloud, scratch))
    number_of = {view.name: number for number, view in enumerate(views)}
    objects, seen = find_objects(views, lambda view: rows[number_of[view.name]], len(cloud), consensus, progress)
    objects = with_masks_of(objects, voters.views, voters.seen, CONSENSUS.rules)
    all_views, all_rows = chained(views, voters.views), chained(rows, voters.point_of_pixel)
    things = thing_objects(
        objects, all_views, chained(seen, voters.seen), cloud, given.classes, preset.evidence.objects
    )
    labels = PanopticLabels(cloud.class_ids, tuple(class_id for _, class_id in things))
    member_of = {
        (mask.frame, mask.segment.id): number for number, (masks, _) in enumerate(things, start=1) for mask in masks
    }
    voted = vote_panoptic_labels(
        all_views, all_rows, len(cloud), labels, member_of, preset.segment_voting.rounds, preset.evidence.segments
    )
    object_of_point = labels.objects(voted.label)
    owner, members = pieces_in_space(things, object_of_point, views, seen, cloud)
    fragment = (object_of_point > 0) & (owner == 0)
    class_id = np.where(fragment, VOID, labels.classes(voted.label)).astype(np.int32)
    cloud = replace(cloud, class_id=class_id, confidence=voted.confidence)
    found = object_instances(views, members, cloud.xyz, owner, preset.voxel_size)
    instances, instance_of_point, dropped = limit_instances(found, owner, preset.most_instances)
    final = PanopticLabels(cloud.class_ids, tuple(one.class_id for one in instances))
    of_point = final.of_points(cloud.class_id, instance_of_point)
    maps = view_labels(views, rows, of_point, len(final))
    return Matching(cloud, instances, instance_of_point, dropped, stored(maps, scratch), rows)


def point_of_pixels(
    views: Sequence[View], cloud: SemanticPointCloud, scratch: Path | None
) -> OnDemand[NDArray[np.int32]]:
    """The point of the cloud that each pixel of the views shows, int32 [H, W] a view, -1 = none. They are stored in
    temporary files in ``scratch``."""
    index, reach = cloud.index(), 2 * cloud.spacing
    return stored((index.nearest_of_pixels(view.camera, view.depth, reach) for view in views), scratch)


def no_objects(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
    """Nothing is matched. The linear assignment decides during training what an instance is."""
    return Matching(given.cloud, [], np.zeros(len(given.cloud), np.int32), 0)


MATCHINGS = {"boxes": instances_by_boxes, "agreement": objects_by_agreement, "none": no_objects}
"""The matchings by the preset's ``objects``."""

MasksOfClass = tuple[Sequence[MemberMask], int]
"""The masks of an object, and its class."""


def thing_objects(
    objects: ObjectMasks,
    views: Sequence[View],
    seen: Sequence[ViewPoints],
    cloud: SemanticPointCloud,
    classes: ClassTable,
    kind: EvidenceKind,
) -> list[MasksOfClass]:
    """The objects that the views vote to be things, with votes of that ``kind``."""
    shown = ((one, shown_classes(view, one)) for view, one in zip(views, seen, strict=True))
    votes = vote_classes(shown, objects.object_of_point, len(objects.masks), cloud.class_ids, kind)
    class_of_object = object_classes(votes, cloud.class_ids)
    return [
        (masks, int(class_id))
        for masks, class_id in zip(objects.masks, class_of_object[1:], strict=True)
        if class_id in classes.thing_ids
    ]


def pieces_in_space(
    things: Sequence[MasksOfClass],
    object_of_point: NDArray[np.int32],
    views: Sequence[View],
    seen: Sequence[ViewPoints],
    cloud: SemanticPointCloud,
) -> tuple[NDArray[np.int32], list[MasksOfClass]]:
    """The objects after their pieces were regrouped: the object that owns each point, int32 [N] (0 = none), and the
    masks of each. ``object_of_point`` int32 [N]: the one of ``things``, from 1, that the views voted for."""
    classes = tuple(class_id for _, class_id in things)
    rules = PieceRules(reach=max(LARGEST_GAP, 3 * cloud.spacing))
    owner, origin = regroup_pieces(cloud.xyz, object_of_point, classes, seen, rules)
    members = masks_of_pieces([masks for masks, _ in things], views, seen, owner, len(origin))
    owner, members, origin = without_fragments(owner, members, origin, seen)
    return owner, [(masks, classes[number - 1]) for masks, number in zip(members, origin, strict=True)]


def masks_of_pieces(
    masks: Sequence[Sequence[MemberMask]],
    views: Sequence[View],
    seen: Sequence[ViewPoints],
    owner: NDArray[np.int32],
    count: int,
) -> list[list[MemberMask]]:
    """The masks of each of ``count`` final objects, in the order of the views. A mask is evidence of the object that
    owns most of its points. Masks of views that only vote are no evidence. ``owner`` int32 [N]: the final object of
    each point, 0 = none."""
    summary_of = {view.name: (number, one) for number, (view, one) in enumerate(zip(views, seen, strict=True))}
    members: list[list[tuple[int, MemberMask]]] = [[] for _ in range(count)]
    for mask in (mask for group in masks for mask in group if mask.frame in summary_of):
        number, summary = summary_of[mask.frame]
        owned = np.bincount(owner[summary.row[summary.segment == mask.segment.id]], minlength=count + 1)
        owned[0] = 0
        if owned.any():
            members[int(owned.argmax()) - 1].append((number, mask))
    return [[mask for _, mask in sorted(group, key=lambda each: each[0])] for group in members]


def without_fragments(
    owner: NDArray[np.int32], members: list[list[MemberMask]], origin: list[int], seen: Sequence[ViewPoints]
) -> tuple[NDArray[np.int32], list[list[MemberMask]], list[int]]:
    """The objects with masks enough, numbered anew from 1: as many as an object needs that is seen by the same views.
    The piece of a split object needs as many as one that all views see: else it is the ragged edge of a few masks."""
    pieces, size = Counter(origin), np.bincount(owner, minlength=len(members) + 1)
    shares = (np.bincount(owner[one.row], minlength=len(size)) / np.maximum(size, 1) for one in seen)
    seeing = sum((share >= 0.5 for share in shares), np.zeros(len(size), np.int64))[1:]
    seeing[[pieces[source] > 1 for source in origin]] = len(seen)
    kept = [place for place, masks in enumerate(members) if len(masks) >= CONSENSUS.least_masks(int(seeing[place]))]
    number = np.zeros(len(members) + 1, np.int32)
    number[[place + 1 for place in kept]] = np.arange(1, len(kept) + 1)
    return number[owner], [members[place] for place in kept], [origin[place] for place in kept]
