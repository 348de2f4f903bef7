"""The targets that supervise each view: its photo, with its exposure, and the labels of its pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..instances.masks import restrict_to_things
from ..model.structured import LabelChannels
from ..presets.preset import Preset
from ..scene import ClassTable, OnDemand, View, stored
from ..semantics.projection import LabelledPoints
from ..train.photos import exposure_gains, sharpness_weights
from ..train.targets import ViewTargets, view_targets
from .objects import Matching, labels_of, point_of_pixels


@dataclass(frozen=True, eq=False)
class Photos:
    """How much each photo counts, ``weights`` float64 [N], and how bright it is, ``gains`` float64 [N, 3] or None."""

    weights: NDArray[np.float64]
    gains: NDArray[np.float64] | None


def compared_photos(
    views: Sequence[View], placed: Sequence[View], matching: Matching, preset: Preset, scratch: Path | None = None
) -> Photos:
    """The photos of the views, compared as the preset asks. ``placed``, ``scratch``: see `targets_of`."""
    weights = sharpness_weights(view.colour for view in views) if preset.weigh_sharpness else np.ones(len(views))
    return Photos(weights, _exposures(views, placed, matching, scratch) if preset.fit_exposure else None)


def targets_of(
    views: Sequence[View],
    placed: Sequence[View],
    matching: Matching,
    photos: Photos,
    channels: LabelChannels,
    classes: ClassTable,
    preset: Preset,
    scratch: Path | None = None,
) -> OnDemand[ViewTargets]:
    """The targets of each view, computed on demand: the labels voted for its segments, or else the projected cloud's
    semantic mask and M_match. ``placed`` are the views with the depth that places pixels in space; ``scratch`` is the
    folder for temporary files."""
    weights, gains = photos.weights, photos.gains
    if matching.label_maps is not None:
        masks = _voted_masks(matching)
    else:
        masks = _projected_masks(placed, matching, classes, preset, scratch)

    with_objects = preset.objects != "none"  # without a matching there are no targets for objects

    def targets(number: int) -> ViewTargets:
        view = views[number]
        projected, matched = masks(number)
        return view_targets(
            view,
            channels,
            projected_class=projected,
            matched_instance=matched if with_objects else None,
            weight=float(weights[number]),
            gain=None if gains is None else gains[number],
        )

    return OnDemand(len(views), targets)


def _exposures(
    views: Sequence[View], placed: Sequence[View], matching: Matching, scratch: Path | None
) -> NDArray[np.float64]:
    """``exposure_gains`` of every second pixel of every second row."""
    rows = matching.point_of_pixel or point_of_pixels(placed, matching.cloud, scratch)
    photos = OnDemand(len(views), lambda number: views[number].colour[::2, ::2])
    points = OnDemand(len(views), lambda number: rows[number][::2, ::2])
    return exposure_gains(photos, points, len(matching.cloud))


Masks = tuple[NDArray[np.int32], NDArray[np.int32]]
"""Class ids and instance ids of a view's pixels, int32 [H, W] each."""


def _voted_masks(matching: Matching) -> Callable[[int], Masks]:
    assert matching.label_maps is not None
    maps = matching.label_maps
    labels = labels_of(matching.cloud, matching.instances)

    def decide(number: int) -> Masks:
        voted = maps[number]
        return labels.classes(voted), labels.objects(voted)

    return decide


def _projected_masks(
    placed: Sequence[View], matching: Matching, classes: ClassTable, preset: Preset, scratch: Path | None
) -> Callable[[int], Masks]:
    cloud, reach = matching.cloud, 2 * preset.voxel_size
    classed = LabelledPoints(cloud.xyz, cloud.class_id)
    owned = LabelledPoints(cloud.xyz, matching.instance_of_point)

    def project(view: View) -> NDArray[np.int32]:
        projected = classed.project(view.camera, view.depth, reach)
        instances = owned.project(view.camera, view.depth, reach)
        return np.stack([projected, restrict_to_things(instances, projected, classes.thing_ids)])

    both = stored((project(view) for view in placed), scratch)

    def masks(number: int) -> Masks:
        projected, instances = both[number]
        return projected, instances

    return masks
