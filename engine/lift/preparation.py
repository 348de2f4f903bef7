"""From views to a scene that can be trained, as in the paper before the first step: consistency-enhanced masks, the
semantic point cloud, Algorithm 1, anchors by voxelisation, and the projected targets."""

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
from ..scene import VOID, ClassTable, OnDemand, Progress, View, stored
from ..scene.hole_filling import fill_holes
from ..semantics.cloud_index import LabelledPoints
from ..semantics.consistency import ConsistencyOptions, consistency_masks, views_are_sparse
from ..semantics.point_cloud import CloudOptions, SemanticPointCloud, build_point_cloud, label_anchors, voxelise
from ..train.photos import exposure_gains, sharpness_weights
from ..train.targets import ViewTargets, view_targets
from ..train.warm_start import warm_start
from .objects import MATCHERS, Matching, ViewsToMatch, labels_of, point_of_pixels

log = logging.getLogger("plgs.lift")

_LARGE = 2.0  # the multiple of the wanted spacing of points above which a lift warns


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedLift(Matching):
    """What training starts from: a matching, which also goes into the result, with the scene that is trained and its
    targets. ``class_of_instance`` maps an instance id to the one class that it is shown with, None if pixels decide."""

    scene: StructuredScene
    targets: Sequence[ViewTargets]
    class_of_instance: Mapping[int, int] | None


@dataclass(frozen=True, eq=False)
class ViewsToLift:
    """``views`` to train on, their ``classes``, the ``preset`` and the ``seed``. ``others`` are views that vote, but
    are not trained on. Arrays of every view are stored in temporary files in ``scratch`` (None: in the system's
    folder for them). ``trained``: the facts of a model from which training goes on, if it has the same labels. ``show``
    is called with the points and the instance of each, int32 [N], as soon as they have classes, and with instances."""

    views: Sequence[View]
    classes: ClassTable
    preset: Preset
    seed: int = 0
    others: Sequence[View] = ()
    scratch: Path | None = None
    trained: Json = None
    show: Callable[[SemanticPointCloud, NDArray[np.int32]], object] = lambda *_: None


def prepare(given: ViewsToLift, stages: StageReporter) -> PreparedLift:
    """Do everything before the first step. Raises Cancelled, and OSError if the disk is full."""
    views, preset = given.views, given.preset
    matching, photos, placed = find(given, stages)
    with stages.stage("prepare") as progress:
        channels = label_channels(used_classes(views), matching.instances, preset)
        viewpoints = np.array([view.camera.centre for view in views])
        start = starting_anchors(matching.cloud, matching.instance_of_point, preset)
        asked = start, channels, viewpoints, preset
        scene = starting_scene(*asked, seed=given.seed, trained=given.trained, progress=progress)
        targets = targets_of(given, placed, matching, photos, channels)
    class_of_instance = {one.id: one.class_id for one in matching.instances} if channels.class_of_slot else None
    return PreparedLift(**vars(matching), scene=scene, targets=targets, class_of_instance=class_of_instance)


def find(given: ViewsToLift, stages: StageReporter) -> tuple[Matching, Photos, Sequence[View]]:
    """The objects of the views, how their photos compare, and the views with the depth that places pixels in space."""
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
    """The semantic point cloud. The labels of the consistency-enhanced masks vote on its classes."""
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
    """The views with the planar holes of their depth filled."""
    depths = stored((fill_holes(view.depth, view.mask.ids) for view in views), scratch)
    return OnDemand(len(views), lambda number: replace(views[number], depth=depths[number]))


def used_classes(views: Sequence[View]) -> tuple[int, ...]:
    """The ids of the classes that masks and detections use, ascending: the semantic channels."""
    masks = (mask for view in views for mask in (view.mask, *view.layers))
    return tuple(sorted({segment.class_id for mask in masks for segment in mask.segments} - {0}))


FEATURES = 32
"""The number of entries in an anchor's feature, as in Scaffold-GS."""


def label_channels(class_ids: tuple[int, ...], instances: Sequence[SceneObject], preset: Preset) -> LabelChannels:
    """A channel for every class, a slot for every instance and one for "no object", and spare slots up to the preset's
    minimum. If nothing was matched, all slots except that for "no object" may be shown."""
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
    """The anchors before the first step: ``positions`` float32 [M, 3] metres, and, from the semantic point cloud,
    ``classes`` and ``owners`` (instance ids) int32 [M], 0 = unknown, and ``rgb`` uint8 [M, 3]."""

    positions: NDArray[np.float32]
    classes: NDArray[np.int32]
    owners: NDArray[np.int32]
    rgb: NDArray[np.uint8]


def starting_anchors(
    cloud: SemanticPointCloud, instance_of_point: NDArray[np.int32], preset: Preset
) -> StartingAnchors:
    """An anchor in each voxel of the semantic point cloud."""
    positions = voxelise(cloud.xyz, preset.voxel_size)
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
    """The anchors with features, and decoders drawn from the seed. The preset decides whether the decoders are fitted
    to the anchors, unless a model with the facts ``trained`` is to replace the scene."""
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
    """How much each photo counts, ``weights`` float64 [N], and how bright it is, ``gains`` float64 [N, 3] or None."""

    weights: NDArray[np.float64]
    gains: NDArray[np.float64] | None = None


def compared_photos(
    views: Sequence[View], placed: Sequence[View], matching: Matching, preset: Preset, scratch: Path | None = None
) -> Photos:
    """The photos of the views, compared as the preset asks. ``placed`` is as in `targets_of`."""
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
    """The targets of each view, computed on demand: the labels voted for its segments, or else the projected cloud's
    semantic mask and M_match. ``placed`` are the views with the depth that places pixels in space."""
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
    """The projected semantic mask and M_match of each view: class ids and instance ids, int32 [2, H, W]."""
    cloud, reach = matching.cloud, 2 * preset.voxel_size
    classed = LabelledPoints(cloud.xyz, cloud.class_id)
    owned = LabelledPoints(cloud.xyz, matching.instance_of_point)

    def project(view: View) -> NDArray[np.int32]:
        projected = classed.project(view.camera, view.depth, reach)
        instances = owned.project(view.camera, view.depth, reach)
        return np.stack([projected, np.where(np.isin(projected, sorted(classes.thing_ids)), instances, 0)])

    return stored((project(view) for view in placed), scratch)
