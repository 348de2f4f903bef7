"""Turns views into a scene to train, as the paper does before the first step: consistency-enhanced masks, the semantic
point cloud, Algorithm 1, anchors by voxelisation, and the projected targets."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..instances.records import SceneObject
from ..job import EventWriter
from ..job.progress import StageProgress, StageReporter
from ..json_file import Json
from ..model.anchors import initial_anchors, seeded_features
from ..model.decoders import DECODERS, DecoderShape
from ..model.structured import NO_OBJECT, SPARE, LabelChannels, StructuredScene, to_tensors
from ..posed.layout import plural
from ..presets.preset import Preset
from ..scene import VOID, ClassTable, OnDemand, Progress, View, made_ahead, stored
from ..scene.hole_filling import fill_holes
from ..semantics.cloud_index import LabelledPoints
from ..semantics.consistency import ConsistencyOptions, consistency_masks, views_are_sparse
from ..semantics.free_space import in_free_space
from ..semantics.point_cloud import CloudOptions, SemanticPointCloud, build_point_cloud, label_anchors, voxelise
from ..train.photos import exposure_gains, sharpness_weights
from ..train.targets import ViewTargets, view_targets
from ..train.warm_start import warm_start
from .objects import MATCHERS, Matching, ViewsToMatch, labels_of, point_of_pixels

log = logging.getLogger("plgs.lift")

_LARGE = 2.0  # the multiple of the wanted spacing of points above which a lift warns


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedLift(Matching):
    """What training starts from: the matching, the ``scene`` to train and its ``targets``. ``class_of_instance``: the
    class with which all of an instance is shown, by id; None if the class may differ from pixel to pixel."""

    scene: StructuredScene
    targets: Sequence[ViewTargets]
    class_of_instance: Mapping[int, int] | None


@dataclass(frozen=True, eq=False)
class ViewsToLift:
    """``views`` to train on, their ``classes``, the ``preset`` and the random ``seed``. ``others``: views that only
    vote. ``scratch``: the folder for temporary files with each view's arrays (None: the system's). ``trained``: facts
    (from `to_tensors`) of a trained model that will replace the scene if it has the same labels. ``show`` is called
    twice, with the cloud and each point's instance int32 [N]: at first all 0, then as matched."""

    views: Sequence[View]
    classes: ClassTable
    preset: Preset
    seed: int = 0
    others: Sequence[View] = ()
    scratch: Path | None = None
    trained: Json = None
    show: Callable[[SemanticPointCloud, NDArray[np.int32]], object] = lambda *_: None


def prepare(given: ViewsToLift, stages: StageReporter) -> PreparedLift:
    """Do everything that comes before the first training step. Raises Cancelled, and OSError if the disk is full."""
    views, preset = given.views, given.preset
    matching, photos, placed = find(given, stages)
    with stages.stage("prepare") as progress:
        channels = label_channels(used_classes(views), matching.instances, preset)
        viewpoints = np.array([view.camera.centre for view in views])
        start = starting_anchors(matching.cloud, matching.instance_of_point, views, preset)
        asked = start, channels, viewpoints, preset
        scene = starting_scene(*asked, seed=given.seed, trained=given.trained, progress=progress)
        targets = targets_of(given, placed, matching, photos, channels)
    class_of_instance = {one.id: one.class_id for one in matching.instances} if channels.class_of_slot else None
    return PreparedLift(**vars(matching), scene=scene, targets=targets, class_of_instance=class_of_instance)


def find(given: ViewsToLift, stages: StageReporter) -> tuple[Matching, Photos, Sequence[View]]:
    """Make the point cloud and match objects. Return the matching, the photos compared, and the views, depth filled."""
    views, preset, scratch = given.views, given.preset, given.scratch
    with stages.stage("consistency") as progress:
        placed = filled_views(views, scratch) if preset.fill_holes else views
        cloud = semantic_cloud(placed, used_classes(views), preset, stages.events, progress)
        given.show(cloud, np.zeros(len(cloud), np.int32))
    with stages.stage("match") as progress:
        to_match = ViewsToMatch(placed, cloud, given.classes, given.others, scratch)
        matching = MATCHERS.chosen(preset.objects)(to_match, preset, progress)
        if matching.dropped:
            found = len(matching.instances) + matching.dropped
            stages.events.warning(
                f"{plural(matching.dropped, 'instance is', 'instances are')} left out, the smallest of {found}: "
                f"at most {preset.most_instances} are kept, --set most_instances={found} keeps all"
            )
        given.show(matching.cloud, matching.instance_of_point)
        photos = compared_photos(views, placed, matching, preset, scratch)
    matching = replace(matching, point_of_pixel=None)  # these files are large, and nothing reads them from here on
    return matching, photos, placed


def semantic_cloud(
    views: Sequence[View], class_ids: tuple[int, ...], preset: Preset, events: EventWriter, progress: StageProgress
) -> SemanticPointCloud:
    """Fuse the views' depth to a point cloud, whose classes the labels of the consistency-enhanced masks vote on."""
    comparison = ConsistencyOptions(neighbours=preset.neighbours, agreement=preset.agreement)
    if preset.neighbours and views_are_sparse(views, comparison):  # none, as in the paper on HyperSim
        comparison = ConsistencyOptions(neighbours=0)
    if comparison.neighbours < preset.neighbours:
        events.warning("neighbouring views overlap too little to compare their labels: all labels are used")
    options = CloudOptions(
        spacing=preset.voxel_size / 2,
        cap=preset.most_points,
        majority=preset.majority,
        evidence=preset.evidence.points,
        most_pixels=preset.most_pixels,
    )
    cloud = build_point_cloud(views, consistency_masks(views, comparison), class_ids, options, progress)
    spacing, got = options.spacing, f"the point cloud has one point every {100 * cloud.spacing:.1f} cm"
    if cloud.spacing > _LARGE * spacing:
        events.warning(f"the scene is large: {got}, not every {100 * spacing:.1f} cm, and small objects may be lost")
    else:
        log.info(got)
    return cloud


def filled_views(views: Sequence[View], scratch: Path | None = None) -> OnDemand[View]:
    """Return the views with planar holes in their depth filled, computed now and kept in ``scratch``."""
    depths = stored(made_ahead(views, lambda view: fill_holes(view.depth, view.mask.ids)), scratch)
    return OnDemand(len(views), lambda number: replace(views[number], depth=depths[number]))


def used_classes(views: Sequence[View]) -> tuple[int, ...]:
    """Return the ids of classes that masks and detections use, ascending. Each gets a semantic channel."""
    masks = (mask for view in views for mask in (view.mask, *view.layers))
    return tuple(sorted({segment.class_id for mask in masks for segment in mask.segments} - {0}))


FEATURES = 32
"""The number of entries in an anchor's feature, as in Scaffold-GS."""


def label_channels(class_ids: tuple[int, ...], instances: Sequence[SceneObject], preset: Preset) -> LabelChannels:
    """Return what the label channels mean: a channel for each class, a slot for each instance, a slot for "no object",
    and spare slots up to the preset's minimum. Without matching, training decides which instance a slot is for."""
    if preset.objects == "none":
        return LabelChannels(class_ids, (*range(1, preset.instance_slots + 1), NO_OBJECT))
    ids = [instance.id for instance in instances]
    spare = max(0, preset.instance_slots - len(ids))
    slots = (*ids, NO_OBJECT, *[SPARE] * spare)
    if not preset.one_class_an_object:
        return LabelChannels(class_ids, slots)
    class_of = {instance.id: instance.class_id for instance in instances}
    return LabelChannels(class_ids, slots, tuple(class_of.get(slot, VOID) for slot in slots))


class StartingAnchors(NamedTuple):
    """The anchors before training. ``positions`` float32 [M, 3], metres. From the semantic point cloud: ``classes`` and
    ``owners`` (instance ids), int32 [M], 0 = unknown, and ``rgb`` uint8 [M, 3]."""

    positions: NDArray[np.float32]
    classes: NDArray[np.int32]
    owners: NDArray[np.int32]
    rgb: NDArray[np.uint8]


def starting_anchors(
    cloud: SemanticPointCloud, instance_of_point: NDArray[np.int32], views: Sequence[View], preset: Preset
) -> StartingAnchors:
    """Place an anchor in each occupied voxel of the point cloud, with the labels and the colour of its points; if the
    preset's ``free_space`` is true, only where the depth of the ``views`` shows no free space."""
    positions = voxelise(cloud.xyz, preset.voxel_size)
    if preset.free_space:
        positions = positions[~in_free_space(positions, views)]
    classes, owners = label_anchors(cloud, instance_of_point, positions, preset.voxel_size)
    nearest = cloud.index().nearest(positions.astype(np.float64), 2 * preset.voxel_size)
    rgb = np.where(nearest[:, None] >= 0, cloud.rgb[nearest], 128).astype(np.uint8)  # grey if none is near
    return StartingAnchors(positions, classes, owners, rgb)


def starting_scene(
    start: StartingAnchors,
    channels: LabelChannels,
    viewpoints: NDArray[np.float64],
    preset: Preset,
    *,
    seed: int,
    trained: Json = None,
    progress: Progress = lambda *_: None,
) -> StructuredScene:
    """Return a scene of the anchors ``start``, with features, and with decoders drawn at random from ``seed``. If the
    preset says so, the decoders are fitted to the anchors, as seen from ``viewpoints`` [N, 3] (camera centres, metres).
    This is skipped if a model with the facts ``trained`` will replace the scene."""
    feature = np.zeros((len(start.positions), FEATURES), np.float32)
    if preset.seeded_features:
        feature = seeded_features(start.rgb, start.classes, start.owners, features=FEATURES, seed=seed)
    anchors = initial_anchors(
        start.positions,
        start.classes,
        gaussians_per_anchor=preset.gaussians_per_anchor,
        feature=feature,
        voxel_size=preset.voxel_size,
    )
    shape = DecoderShape(
        features=FEATURES,
        gaussians_per_anchor=preset.gaussians_per_anchor,
        classes=len(channels.class_ids),
        instance_slots=len(channels.slot_ids),
        distance_input=preset.distance_input,
        label_view_input=preset.label_view_input,
    )
    scene = StructuredScene(anchors, DECODERS.chosen(preset.head)(shape, seed), channels, preset.voxel_size)
    if preset.warm_start and to_tensors(scene)[1] != trained:
        owners = start.owners if preset.objects != "none" else None
        warm_start(scene, start.rgb, owners, viewpoints, seed=seed, progress=progress)
    return scene


@dataclass(frozen=True, eq=False)
class Photos:
    """The photos of N views compared with each other. ``weights`` float64 [N]: how much each photo counts in training.
    ``gains`` float64 [N, 3] or None: each photo's exposure by channel, relative to the others."""

    weights: NDArray[np.float64]
    gains: NDArray[np.float64] | None = None


def compared_photos(
    views: Sequence[View], placed: Sequence[View], matching: Matching, preset: Preset, scratch: Path | None = None
) -> Photos:
    """Compare the views' photos by sharpness and exposure, if the preset asks for it. ``placed``: the views with holes
    in depth filled; ``matching`` tells what they show."""
    weights = sharpness_weights(view.colour for view in views) if preset.weigh_sharpness else np.ones(len(views))
    if not preset.fit_exposure:
        return Photos(weights)
    rows = matching.point_of_pixel or point_of_pixels(placed, matching.cloud, scratch)
    # Every second pixel of every second row suffices.
    photos = OnDemand(len(views), lambda number: views[number].colour[::2, ::2])
    points = OnDemand(len(views), lambda number: rows[number][::2, ::2])
    return Photos(weights, exposure_gains(photos, points, len(matching.cloud)))


def targets_of(
    given: ViewsToLift, placed: Sequence[View], matching: Matching, photos: Photos, channels: LabelChannels
) -> OnDemand[ViewTargets]:
    """Return each view's training targets, computed when read: the labels voted on pixels or, without votes, the point
    cloud projected to the view (classes, and M_match for instances). ``placed``: the views with their depth filled."""
    views, preset = given.views, given.preset
    weights, gains, maps = photos.weights, photos.gains, matching.label_maps
    labels = labels_of(matching.cloud, matching.instances)
    masks = None if maps is not None else projected_masks(placed, matching, given.classes, preset, given.scratch)
    with_objects = preset.objects != "none"  # without a matching there are no targets for objects

    def targets(number: int) -> ViewTargets:
        if masks is None:
            assert maps is not None
            projected, matched = labels.classes(maps[number]), labels.objects(maps[number])
        else:
            projected, matched = masks[number]
        return view_targets(
            views[number],
            channels,
            projected_class=projected,
            matched_instance=matched if with_objects else None,
            teach_no_object=preset.teach_no_object,
            weight=float(weights[number]),
            gain=None if gains is None else gains[number],
        )

    return OnDemand(len(views), targets)


def projected_masks(
    placed: Sequence[View], matching: Matching, classes: ClassTable, preset: Preset, scratch: Path | None
) -> OnDemand[NDArray[np.int32]]:
    """Return the point cloud's class ids and instance ids (M_match) projected to each view, int32 [2, H, W]."""
    cloud, reach = matching.cloud, 2 * preset.voxel_size
    classed = LabelledPoints(cloud.xyz, cloud.class_id)
    owned = LabelledPoints(cloud.xyz, matching.instance_of_point)

    def project(view: View) -> NDArray[np.int32]:
        projected = classed.project(view.camera, view.depth, reach)
        instances = owned.project(view.camera, view.depth, reach)
        return np.stack([projected, np.where(np.isin(projected, sorted(classes.thing_ids)), instances, 0)])

    return stored((project(view) for view in placed), scratch)
