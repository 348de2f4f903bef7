"""From views to a scene that can be trained: what the paper does before the first step.

Consistency-enhanced masks, the semantic point cloud, Algorithm 1, anchors by voxelisation, and the projected targets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..instances import (
    GlobalInstance,
    MatchingOptions,
    MemberMask,
    ObjectMasks,
    PieceRules,
    SegmentOptions,
    ViewPoints,
    find_objects,
    limit_instances,
    match_views,
    object_instances,
    regroup_pieces,
    restrict_to_things,
    shown_classes,
    vote_instances,
)
from ..model.anchors import initial_anchors
from ..model.decoders import Decoders, DecoderShape
from ..model.features import seeded_features
from ..model.structured import NO_OBJECT, SPARE, LabelChannels, StructuredScene
from ..scene import VOID, ClassTable, View
from ..scene.hole_filling import fill_holes
from ..semantics import (
    UNKNOWN_LABEL,
    CloudOptions,
    ConsistencyOptions,
    LabelledPoints,
    PanopticLabels,
    SemanticPointCloud,
    build_point_cloud,
    consistency_masks,
    label_anchors,
    object_classes,
    project_labels,
    segment_labels,
    views_are_sparse,
    vote_classes,
    vote_panoptic_labels,
    voxelise,
)
from .photos import exposure_gains, sharpness_weights
from .presets import Preset
from .progress import StageProgress, StageReporter
from .targets import ViewTargets, view_targets
from .warm_start import warm_start


@dataclass(frozen=True, eq=False)
class PreparedLift:
    """What training starts from. ``cloud`` with ``instance_of_point`` int32 [N] (0 = none) and ``instances`` also go
    into the result. ``class_of_instance``: instance id to the class that all of it is shown with, or None when every
    pixel decides for itself. ``label_maps``: the panoptic label that each view's pixels were given, int16 [H, W] (-1 =
    unknown), where segments and points voted on them; else None."""

    scene: StructuredScene
    targets: list[ViewTargets]
    cloud: SemanticPointCloud
    instance_of_point: NDArray[np.int32]
    instances: tuple[GlobalInstance, ...]
    class_of_instance: Mapping[int, int] | None
    label_maps: list[NDArray[np.int16]] | None


def prepare(
    views: Sequence[View], classes: ClassTable, preset: Preset, seed: int, stages: StageReporter
) -> PreparedLift:
    """Everything before the first step. Raises what the progress callbacks raise (Cancelled)."""
    class_ids = used_classes(views)
    with stages.stage("consistency") as progress:
        placed = [filled_view(view) for view in views] if preset.fill_holes else list(views)
        comparison = consistency_options(placed, preset)
        if comparison.neighbours < preset.neighbours:
            stages.events.warning("neighbouring views overlap too little to compare labels: all labels are used")
        options = CloudOptions(
            spacing=preset.voxel_size / 2, cap=preset.most_points, ballot=preset.ballot, majority=preset.majority
        )
        cloud = build_point_cloud(placed, consistency_masks(placed, comparison), class_ids, options, progress)
        if cloud.spacing > options.spacing:
            wanted, got = (f"{100 * metres:.1f} cm" for metres in (options.spacing, cloud.spacing))
            stages.events.warning(f"the scene is large: the point cloud has a point every {got}, not every {wanted}")
    with stages.stage("match") as progress:
        match = objects_by_consent if preset.objects == "consent" else instances_by_boxes
        matching = match(placed, cloud, classes, preset, progress)
        if matching.dropped:
            found = len(matching.instances) + matching.dropped
            stages.events.warning(f"the {matching.dropped} smallest of {found} instances are left out")
    channels = label_channels(class_ids, matching.instances, preset)
    viewpoints = np.array([view.camera.centre for view in views])
    scene = starting_scene(matching.cloud, matching.instance_of_point, channels, viewpoints, preset, seed)
    targets = list(targets_of(views, placed, matching, channels, classes, preset))
    class_of_instance = {one.id: one.class_id for one in matching.instances} if preset.one_class_an_object else None
    return PreparedLift(
        scene,
        targets,
        matching.cloud,
        matching.instance_of_point,
        tuple(matching.instances),
        class_of_instance,
        matching.label_maps,
    )


LARGEST_GAP = 0.15
"""Metres between neighbouring points of one object: about what a far view leaves between two pixels."""


@dataclass(frozen=True, eq=False)
class Matching:
    """The ``cloud`` with its final classes, the ``instances`` with ids 1.., the instance of each point int32 [N] (0 =
    none), how many more instances were ``dropped``, and ``label_maps`` as ``PreparedLift`` has them."""

    cloud: SemanticPointCloud
    instances: list[GlobalInstance]
    instance_of_point: NDArray[np.int32]
    dropped: int
    label_maps: list[NDArray[np.int16]] | None = None


def filled_view(view: View) -> View:
    """The view with the planar holes of its depth filled."""
    return replace(view, depth=fill_holes(view.depth, view.mask.ids))


def instances_by_boxes(
    views: Sequence[View], cloud: SemanticPointCloud, classes: ClassTable, preset: Preset, progress: StageProgress
) -> Matching:
    """The paper's way: Algorithm 1 on the thing segments of all views."""
    found = match_views(
        views,
        classes.thing_ids,
        SegmentOptions(voxel_size=preset.voxel_size),
        MatchingOptions(tau_new=preset.tau_new),
        progress,
    )
    owner_of_segment = {(item.frame, item.segment_id): one.id for one in found for item in one.evidence}
    index, reach = cloud.index(), 2 * preset.voxel_size
    owner = vote_instances(
        views, lambda view: index.nearest_of_pixels(view.camera, view.depth, reach), len(cloud), owner_of_segment
    )
    owner[~np.isin(cloud.class_id, sorted(classes.thing_ids))] = 0
    instances, instance_of_point, dropped = limit_instances(found, owner, preset.most_instances)
    return Matching(cloud, instances, instance_of_point, dropped)


def objects_by_consent(
    views: Sequence[View], cloud: SemanticPointCloud, classes: ClassTable, preset: Preset, progress: StageProgress
) -> Matching:
    """Ours: objects that the views agree on, whatever they call them; the views vote on each object's class; then
    segments and points vote on what every pixel shows."""
    index, reach = cloud.index(), 2 * cloud.spacing
    rows = {view.name: index.nearest_of_pixels(view.camera, view.depth, reach) for view in views}
    objects, seen = find_objects(views, lambda view: rows[view.name], len(cloud), preset.consensus, progress)
    things = thing_objects(objects, views, seen, cloud, classes)
    in_order = [rows[view.name] for view in views]
    labels = PanopticLabels(cloud.class_ids, tuple(class_id for _, class_id in things))
    member_of = {
        (mask.frame, mask.segment.id): number
        for number, (masks, _) in enumerate(things, start=1)
        for mask in masks
    }
    voted = vote_panoptic_labels(views, in_order, len(cloud), labels, member_of, preset.segment_voting)
    rules = PieceRules(reach=max(LARGEST_GAP, 3 * cloud.spacing))
    owner = labels.objects(voted.label)
    owner, origin = regroup_pieces(cloud.xyz, owner, labels.class_of_object, seen, rules)
    unknown = (labels.objects(voted.label) > 0) & (owner == 0)  # crumbs
    class_id = np.where(unknown, VOID, labels.classes(voted.label)).astype(np.int32)
    cloud = replace(cloud, class_id=class_id, confidence=voted.confidence)
    found = object_instances(
        views, [things[number - 1] for number in origin], cloud.xyz, owner, preset.voxel_size
    )
    instances, instance_of_point, dropped = limit_instances(found, owner, preset.most_instances)
    final = PanopticLabels(cloud.class_ids, tuple(one.class_id for one in instances))
    of_point = final.of_points(cloud.class_id, instance_of_point)
    maps = [
        segment_labels(view.mask, np.append(of_point, UNKNOWN_LABEL)[row], len(final), preset.segment_voting.agreement)
        for view, row in zip(views, in_order, strict=True)
    ]
    return Matching(cloud, instances, instance_of_point, dropped, maps)


def thing_objects(
    objects: ObjectMasks,
    views: Sequence[View],
    seen: Sequence[ViewPoints],
    cloud: SemanticPointCloud,
    classes: ClassTable,
) -> list[tuple[tuple[MemberMask, ...], int]]:
    """The objects that the views vote to be things: their masks, and the class of each."""
    shown = ((one.row, shown_classes(view, one), one.pixels) for view, one in zip(views, seen, strict=True))
    votes = vote_classes(shown, objects.object_of_point, len(objects.masks), cloud.class_ids)
    class_of_object, _ = object_classes(votes, cloud.class_ids)
    return [
        (masks, int(class_id))
        for masks, class_id in zip(objects.masks, class_of_object[1:], strict=True)
        if class_id in classes.thing_ids
    ]


def used_classes(views: Sequence[View]) -> tuple[int, ...]:
    """Ids of the classes that the masks use, ascending: the semantic channels."""
    return tuple(sorted({segment.class_id for view in views for segment in view.mask.segments} - {0}))


def label_channels(class_ids: tuple[int, ...], instances: Sequence[GlobalInstance], preset: Preset) -> LabelChannels:
    """A channel for every class, and a slot for every instance, for "no object", and spare ones up to the preset's
    least number of slots."""
    ids = [instance.id for instance in instances]
    spare = max(0, preset.instance_slots - len(ids))
    slots = (*ids, NO_OBJECT, *[SPARE] * spare)
    if not preset.one_class_an_object:
        return LabelChannels(class_ids, slots)
    class_of = {instance.id: instance.class_id for instance in instances}
    return LabelChannels(class_ids, slots, tuple(class_of.get(slot, VOID) for slot in slots))


def consistency_options(views: Sequence[View], preset: Preset) -> ConsistencyOptions:
    """The preset's choice, or no comparison where views are too sparse for one (as the paper does on HyperSim)."""
    options = ConsistencyOptions(neighbours=preset.neighbours, agreement=preset.agreement)
    if not preset.neighbours:
        return options
    return ConsistencyOptions(neighbours=0) if views_are_sparse(views, options) else options


def targets_of(
    views: Sequence[View],
    placed: Sequence[View],
    matching: Matching,
    channels: LabelChannels,
    classes: ClassTable,
    preset: Preset,
) -> Iterator[ViewTargets]:
    """What each view is supervised with: the labels its segments were voted, or else the projected cloud's semantic
    mask and M_match. ``placed`` are the views with the depth that places pixels in space."""
    photos = [view.colour for view in views]
    weights = sharpness_weights(photos) if preset.weigh_sharpness else np.ones(len(views))
    gains = _exposures(views, placed, matching.cloud) if preset.fit_exposure else None
    project = _voted_masks(matching) if matching.label_maps is not None else _projected_masks(matching, classes, preset)
    for number, view in enumerate(views):
        projected, matched = project(number, placed[number])
        yield view_targets(
            view,
            channels,
            projected_class=projected,
            matched_instance=matched,
            weight=float(weights[number]),
            gain=None if gains is None else gains[number],
        )


def _exposures(
    views: Sequence[View], placed: Sequence[View], cloud: SemanticPointCloud
) -> NDArray[np.float64]:
    index, reach = cloud.index(), 2 * cloud.spacing
    rows = [index.nearest_of_pixels(view.camera, view.depth, reach)[::2, ::2] for view in placed]
    return exposure_gains([view.colour[::2, ::2] for view in views], rows, len(cloud))


Masks = tuple[NDArray[np.int32], NDArray[np.int32]]
"""Class ids and instance ids of a view's pixels, int32 [H, W] each."""


def _voted_masks(matching: Matching) -> Callable[[int, View], Masks]:
    assert matching.label_maps is not None
    maps = matching.label_maps
    labels = PanopticLabels(matching.cloud.class_ids, tuple(one.class_id for one in matching.instances))
    return lambda number, view: (labels.classes(maps[number]), labels.objects(maps[number]))


def _projected_masks(matching: Matching, classes: ClassTable, preset: Preset) -> Callable[[int, View], Masks]:
    cloud, reach = matching.cloud, 2 * preset.voxel_size
    classed = LabelledPoints(cloud.xyz, cloud.class_id, cloud.spacing)
    owned = LabelledPoints(cloud.xyz, matching.instance_of_point, cloud.spacing)

    def project(number: int, view: View) -> Masks:
        projected = project_labels(view.camera, view.depth, classed, reach)
        instances = project_labels(view.camera, view.depth, owned, reach)
        return projected, restrict_to_things(instances, projected, classes.thing_ids)

    return project


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
