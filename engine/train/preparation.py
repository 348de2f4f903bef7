"""From views to a scene that can be trained: what the paper does before the first step.

Consistency-enhanced masks, the semantic point cloud, Algorithm 1, anchors by voxelisation, and the projected targets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..instances import (
    ConsensusOptions,
    GlobalInstance,
    MatchingOptions,
    SegmentOptions,
    find_objects,
    limit_instances,
    match_views,
    object_instances,
    restrict_to_things,
    shown_classes,
    vote_instances,
    without_strays,
)
from ..model.anchors import initial_anchors
from ..model.decoders import Decoders, DecoderShape
from ..model.features import seeded_features
from ..model.structured import LabelChannels, StructuredScene
from ..scene import ClassTable, View
from ..semantics import (
    CloudOptions,
    ConsistencyOptions,
    LabelledPoints,
    SemanticPointCloud,
    build_point_cloud,
    consistency_masks,
    label_anchors,
    label_by_object,
    object_classes,
    project_labels,
    views_are_sparse,
    vote_classes,
    voxelise,
)
from .presets import Preset
from .progress import StageProgress, StageReporter
from .targets import ViewTargets, view_targets
from .warm_start import warm_start


@dataclass(frozen=True, eq=False)
class PreparedLift:
    """What training starts from. ``cloud`` with ``instance_of_point`` int32 [N] (0 = none) and ``instances`` also go
    into the result. ``class_of_instance``: instance id to the class that all of it is shown with, or None when every
    pixel decides for itself."""

    scene: StructuredScene
    targets: list[ViewTargets]
    cloud: SemanticPointCloud
    instance_of_point: NDArray[np.int32]
    instances: tuple[GlobalInstance, ...]
    class_of_instance: Mapping[int, int] | None


def prepare(
    views: Sequence[View], classes: ClassTable, preset: Preset, seed: int, stages: StageReporter
) -> PreparedLift:
    """Everything before the first step. Raises what the progress callbacks raise (Cancelled)."""
    class_ids = used_classes(views)
    with stages.stage("believe") as progress:
        comparison = consistency_options(views, preset)
        if comparison.neighbours < preset.neighbours:
            stages.events.warning("neighbouring views overlap too little to compare labels; all labels are believed")
        options = CloudOptions(
            spacing=preset.voxel_size / 2, cap=preset.most_points, ballot=preset.ballot, majority=preset.majority
        )
        cloud = build_point_cloud(views, consistency_masks(views, comparison), class_ids, options, progress)
        if cloud.spacing > options.spacing:
            wanted, got = (f"{100 * metres:.1f} cm" for metres in (options.spacing, cloud.spacing))
            stages.events.warning(f"the scene is large: the point cloud has a point every {got}, not every {wanted}")
    with stages.stage("match") as progress:
        match = objects_by_consent if preset.objects == "consent" else instances_by_boxes
        cloud, found, instance_of_point = match(views, cloud, classes, preset, progress)
        instances, instance_of_point, dropped = limit_instances(found, instance_of_point, preset.most_instances)
        if dropped:
            stages.events.warning(f"the {dropped} smallest of {len(found)} instances are left out")
    channels = LabelChannels(class_ids, slots(instances, preset.instance_slots))
    viewpoints = np.array([view.camera.centre for view in views])
    scene = starting_scene(cloud, instance_of_point, channels, viewpoints, preset, seed)
    targets = projected_targets(views, cloud, instance_of_point, channels, classes, 2 * preset.voxel_size)
    class_of_instance = {one.id: one.class_id for one in instances} if preset.one_class_an_object else None
    return PreparedLift(scene, targets, cloud, instance_of_point, tuple(instances), class_of_instance)


LARGEST_GAP = 0.15
"""Metres between neighbouring points of one object: about what a far view leaves between two pixels."""

Matching = tuple[SemanticPointCloud, list[GlobalInstance], NDArray[np.int32]]
"""The cloud with its final classes, the instances, and the instance of each point int32 [N] (0 = none)."""


def instances_by_boxes(
    views: Sequence[View], cloud: SemanticPointCloud, classes: ClassTable, preset: Preset, progress: StageProgress
) -> Matching:
    """The paper's way: Algorithm 1 on the thing segments of all views."""
    instances = match_views(
        views,
        classes.thing_ids,
        SegmentOptions(voxel_size=preset.voxel_size),
        MatchingOptions(tau_new=preset.tau_new),
        progress,
    )
    owner_of_segment = {(item.frame, item.segment_id): one.id for one in instances for item in one.evidence}
    index, reach = cloud.index(), 2 * preset.voxel_size
    instance_of_point = vote_instances(
        views, lambda view: index.nearest_of_pixels(view.camera, view.depth, reach), len(cloud), owner_of_segment
    )
    instance_of_point[~np.isin(cloud.class_id, sorted(classes.thing_ids))] = 0
    return cloud, instances, instance_of_point


def objects_by_consent(
    views: Sequence[View], cloud: SemanticPointCloud, classes: ClassTable, preset: Preset, progress: StageProgress
) -> Matching:
    """Ours: objects that the views agree on, whatever they call them; then the views vote on each object's class."""
    index, reach = cloud.index(), 2 * cloud.spacing
    objects, seen = find_objects(
        views,
        lambda view: index.nearest_of_pixels(view.camera, view.depth, reach),
        len(cloud),
        ConsensusOptions(),
        progress,
    )
    shown = ((one.row, shown_classes(view, one), one.pixels) for view, one in zip(views, seen, strict=True))
    votes = vote_classes(shown, objects.object_of_point, cloud.class_ids)
    class_of_object, _ = object_classes(votes, cloud.class_ids)
    _, owner = label_by_object(cloud, objects.object_of_point, votes, classes.thing_ids)
    owner = without_strays(cloud.xyz, owner, max(LARGEST_GAP, 4 * cloud.spacing))
    cloud, object_of_point = label_by_object(cloud, owner, votes, classes.thing_ids)
    instances, instance_of_point = object_instances(
        views, objects, cloud.xyz, class_of_object, object_of_point, preset.voxel_size
    )
    return cloud, instances, instance_of_point


def used_classes(views: Sequence[View]) -> tuple[int, ...]:
    """Ids of the classes that the masks use, ascending: the semantic channels."""
    return tuple(sorted({segment.class_id for view in views for segment in view.mask.segments} - {0}))


def slots(instances: Sequence[GlobalInstance], least: int) -> tuple[int, ...]:
    """Instance id of each slot: the matched objects, then spare slots (0) up to ``least``."""
    ids = [instance.id for instance in instances]
    return tuple(ids + [0] * max(0, least - len(ids)))


def consistency_options(views: Sequence[View], preset: Preset) -> ConsistencyOptions:
    """The preset's choice, or no comparison where views are too sparse for one (as the paper does on HyperSim)."""
    options = ConsistencyOptions(neighbours=preset.neighbours, agreement=preset.agreement)
    if not preset.neighbours:
        return options
    return ConsistencyOptions(neighbours=0) if views_are_sparse(views, options) else options


def projected_targets(
    views: Sequence[View],
    cloud: SemanticPointCloud,
    instance_of_point: NDArray[np.int32],
    channels: LabelChannels,
    classes: ClassTable,
    reach: float,
) -> list[ViewTargets]:
    """Each view's semantic mask and M_match, projected from the cloud."""
    classed = LabelledPoints(cloud.xyz, cloud.class_id, cloud.spacing)
    owned = LabelledPoints(cloud.xyz, instance_of_point, cloud.spacing)
    targets = []
    for view in views:
        projected = project_labels(view.camera, view.depth, classed, reach)
        matched = restrict_to_things(
            project_labels(view.camera, view.depth, owned, reach), projected, classes.thing_ids
        )
        targets.append(view_targets(view, channels, projected_class=projected, matched_instance=matched))
    return targets


def starting_scene(
    cloud: SemanticPointCloud,
    instance_of_point: NDArray[np.int32],
    channels: LabelChannels,
    viewpoints: NDArray[np.float64],
    preset: Preset,
    seed: int,
) -> StructuredScene:
    """Anchors on the semantic point cloud; decoders drawn from the seed, then fitted to them if the preset says so."""
    positions = voxelise(cloud.xyz, preset.voxel_size)
    classes, owners = label_anchors(cloud, instance_of_point, positions, preset.voxel_size)
    nearest = cloud.index().nearest(positions.astype(np.float64), 2 * preset.voxel_size)
    rgb = np.where(nearest[:, None] >= 0, cloud.rgb[nearest], 128).astype(np.uint8)
    feature = np.zeros((len(positions), preset.features), np.float32)
    if preset.seeded_features:
        feature = seeded_features(rgb, classes, owners, features=preset.features, seed=seed)
    anchors = initial_anchors(
        positions,
        classes,
        gaussians_per_anchor=preset.gaussians_per_anchor,
        feature=feature,
        voxel_size=preset.voxel_size,
    )
    shape = DecoderShape(
        features=preset.features,
        gaussians_per_anchor=preset.gaussians_per_anchor,
        classes=len(channels.class_ids),
        instance_slots=len(channels.slot_ids),
        distance_input=preset.distance_input,
        label_view_input=preset.label_view_input,
    )
    scene = StructuredScene(anchors, Decoders(shape, seed), channels, preset.voxel_size)
    if preset.warm_start is not None:
        warm_start(scene, rgb, owners, viewpoints, preset.warm_start, seed)
    return scene
