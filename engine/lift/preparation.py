"""From views to a scene that can be trained, as in the paper before the first step: consistency-enhanced masks, the
semantic point cloud, Algorithm 1, anchors by voxelisation, and the projected targets."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..job import EventWriter
from ..model.structured import StructuredScene
from ..posed.layout import plural
from ..presets.preset import Preset
from ..scene import ClassTable, OnDemand, View, stored
from ..scene.hole_filling import fill_holes
from ..semantics.adaptive_spacing import ENLARGED
from ..semantics.consistency import ConsistencyOptions, consistency_masks, views_are_sparse
from ..semantics.point_cloud import CloudOptions, SemanticPointCloud, build_point_cloud
from ..train.progress import StageProgress, StageReporter
from ..train.targets import ViewTargets
from .objects import MATCHINGS, Matching, ViewsToMatch
from .starting_scene import label_channels, starting_anchors, starting_scene
from .targets_of_views import Photos, compared_photos, targets_of

log = logging.getLogger("plgs.lift")


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedLift(Matching):
    """What training starts from: a matching, which also goes into the result, with the scene that is trained and its
    targets. ``class_of_instance`` maps an instance id to the one class that it is shown with, or is None if every
    pixel decides on its own."""

    scene: StructuredScene
    targets: Sequence[ViewTargets]
    class_of_instance: Mapping[int, int] | None


def prepare(
    views: Sequence[View],
    classes: ClassTable,
    preset: Preset,
    seed: int,
    stages: StageReporter,
    scratch: Path | None = None,
    others: Sequence[View] = (),
) -> PreparedLift:
    """Do everything before the first step. Arrays of every view are stored in temporary files in ``scratch`` (None: in
    the system's folder for them). ``others`` are views that vote, but are not trained on. Raises what the
    progress callbacks raise (Cancelled), and OSError if the disk is full."""
    matching, photos, placed = find(views, classes, preset, stages, scratch, others)
    with stages.stage("prepare") as progress:
        channels = label_channels(used_classes(views), matching.instances, preset)
        viewpoints = np.array([view.camera.centre for view in views])
        start = starting_anchors(matching.cloud, matching.instance_of_point, preset)
        scene = starting_scene(start, channels, viewpoints, preset, seed, progress=progress)
        targets = targets_of(views, placed, matching, photos, channels, classes, preset, scratch)
    class_of_instance = {one.id: one.class_id for one in matching.instances} if channels.class_of_slot else None
    return PreparedLift(**vars(matching), scene=scene, targets=targets, class_of_instance=class_of_instance)


def find(
    views: Sequence[View],
    classes: ClassTable,
    preset: Preset,
    stages: StageReporter,
    scratch: Path | None,
    others: Sequence[View],
) -> tuple[Matching, Photos, Sequence[View]]:
    """The objects of the views, how their photos compare, and the views with the depth that places pixels in space."""
    with stages.stage("consistency") as progress:
        placed = filled_views(views, scratch) if preset.fill_holes else views
        cloud = semantic_cloud(placed, used_classes(views), preset, stages.events, progress)
    with stages.stage("match") as progress:
        given = ViewsToMatch(placed, cloud, classes, others, scratch)
        matching = MATCHINGS[preset.objects](given, preset, progress)
        if matching.dropped:
            found = len(matching.instances) + matching.dropped
            stages.events.warning(
                f"{plural(matching.dropped, 'instance is', 'instances are')} left out, the smallest of {found}: "
                f"at most {preset.most_instances} are kept, --set most_instances={found} keeps all"
            )
        photos = compared_photos(views, placed, matching, preset, scratch)
    matching = replace(matching, point_of_pixel=None)  # these files are large, and nothing reads them from here on
    return matching, photos, placed


def semantic_cloud(
    views: Sequence[View], class_ids: tuple[int, ...], preset: Preset, events: EventWriter, progress: StageProgress
) -> SemanticPointCloud:
    """The semantic point cloud. The labels of the consistency-enhanced masks vote on its classes."""
    comparison = consistency_options(views, preset)
    if comparison.neighbours < preset.neighbours:
        events.warning("neighbouring views overlap too little to compare their labels: all labels are used")
    options = CloudOptions(
        spacing=preset.voxel_size / 2, cap=preset.most_points, evidence=preset.evidence.points, majority=preset.majority
    )
    cloud = build_point_cloud(views, consistency_masks(views, comparison), class_ids, options, progress)
    spacing, got = options.spacing, f"the point cloud has one point every {100 * cloud.spacing:.1f} cm"
    if cloud.spacing > ENLARGED * spacing:
        events.warning(f"the scene is large: {got}, not every {100 * spacing:.1f} cm, and small objects may be lost")
    else:
        log.info(got)
    return cloud


def filled_views(views: Sequence[View], scratch: Path | None = None) -> OnDemand[View]:
    """The views with the planar holes of their depth filled."""
    depths = stored((fill_holes(view.depth, view.mask.ids) for view in views), scratch)
    return OnDemand(len(views), lambda number: replace(views[number], depth=depths[number]))


def used_classes(views: Sequence[View]) -> tuple[int, ...]:
    """The ids of the classes that the masks use, ascending: the semantic channels."""
    return tuple(sorted({segment.class_id for view in views for segment in view.mask.segments} - {0}))


def consistency_options(views: Sequence[View], preset: Preset) -> ConsistencyOptions:
    """The preset's choice, or no comparison if views are too sparse for one (as in the paper on HyperSim)."""
    options = ConsistencyOptions(neighbours=preset.neighbours)
    if not preset.neighbours:
        return options
    return ConsistencyOptions(neighbours=0) if views_are_sparse(views, options) else options
