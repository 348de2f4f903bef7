"""What each view is supervised with: its photo, with its exposure, and the labels that its pixels were given."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..instances import PanopticLabels, restrict_to_things
from ..model.structured import LabelChannels
from ..scene import ClassTable, View
from ..semantics import LabelledPoints, SemanticPointCloud, project_labels
from ..train.photos import exposure_gains, sharpness_weights
from ..train.presets import Preset
from ..train.targets import ViewTargets, view_targets
from .objects import Matching


def targets_of(
    views: Sequence[View],
    placed: Sequence[View],
    matching: Matching,
    channels: LabelChannels,
    classes: ClassTable,
    preset: Preset,
) -> Iterator[ViewTargets]:
    """What each view is supervised with: the labels its segments were voted, or else the projected cloud's semantic
    mask and M_match; or what else the preset says. ``placed`` are the views with the depth that places pixels in
    space."""
    photos = [view.colour for view in views]
    weights = sharpness_weights(photos) if preset.weigh_sharpness else np.ones(len(views))
    gains = _exposures(views, placed, matching.cloud) if preset.fit_exposure else None
    project = _voted_masks(matching) if matching.label_maps is not None else _projected_masks(matching, classes, preset)
    for number, view in enumerate(views):
        projected, matched = project(number, placed[number])
        if preset.semantic_targets != "projected":
            projected = view.mask.class_map() if preset.semantic_targets == "masks" else np.zeros_like(projected)
        yield view_targets(
            view,
            channels,
            projected_class=projected,
            matched_instance=matched if preset.matched_masks else None,
            with_segments=preset.weights.segment > 0,
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
