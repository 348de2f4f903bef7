"""The structured scene before the first step: anchors on the semantic point cloud, and decoders (see the paper's
section "Structured Panoptic-Aware Scene Representation")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..instances.records import SceneObject
from ..model.anchors import initial_anchors, seeded_features
from ..model.decoders import Decoders, DecoderShape
from ..model.structured import NO_OBJECT, SPARE, LabelChannels, StructuredScene
from ..presets.preset import Preset
from ..scene import VOID, Progress
from ..semantics.anchor_labels import label_anchors, voxelise
from ..semantics.point_cloud import SemanticPointCloud
from ..train.warm_start import warm_start

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
    rgb = np.where(nearest[:, None] >= 0, cloud.rgb[nearest], 128).astype(np.uint8)
    return StartingAnchors(positions, classes, owners, rgb)


def starting_scene(
    start: StartingAnchors,
    channels: LabelChannels,
    viewpoints: NDArray[np.float64],
    preset: Preset,
    seed: int,
    progress: Progress = lambda *_: None,
) -> StructuredScene:
    """The anchors with features, and decoders drawn from the seed. The preset decides whether the decoders are fitted
    to the anchors."""
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
    scene = StructuredScene(anchors, Decoders(shape, seed), channels, preset.voxel_size)
    if preset.warm_start:
        owners = start.owners if preset.objects != "none" else None
        warm_start(scene, start.rgb, owners, viewpoints, seed, progress)
    return scene
