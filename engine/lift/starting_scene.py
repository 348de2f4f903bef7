"""The structured scene before the first step: anchors on the semantic point cloud, and decoders (paper, section
"Structured Panoptic-Aware Scene Representation")."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..instances import GlobalInstance
from ..model.anchors import initial_anchors
from ..model.decoders import DecoderShape
from ..model.features import seeded_features
from ..model.plain import PlainDecoders, plain_gaussians, plain_shape
from ..model.structured import NO_OBJECT, SPARE, LabelChannels, StructuredScene, new_decoders
from ..scene import VOID
from ..semantics import SemanticPointCloud, label_anchors, voxelise
from ..train.presets import Preset
from ..train.warm_start import warm_start


def label_channels(class_ids: tuple[int, ...], instances: Sequence[GlobalInstance], preset: Preset) -> LabelChannels:
    """A channel for every class, and a slot for every instance, for "no object", and spare ones up to the preset's
    least number of slots. Where nothing was matched all slots but that for "no object" may be shown."""
    if preset.objects == "none":
        return LabelChannels(class_ids, (*range(1, preset.instance_slots + 1), NO_OBJECT))
    ids = [instance.id for instance in instances]
    spare = max(0, preset.instance_slots - len(ids))
    slots = (*ids, NO_OBJECT, *[SPARE] * spare)
    if not preset.one_class_an_object:
        return LabelChannels(class_ids, slots)
    class_of = {instance.id: instance.class_id for instance in instances}
    return LabelChannels(class_ids, slots, tuple(class_of.get(slot, VOID) for slot in slots))


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
    if not preset.labelled_start:
        classes, owners = np.zeros_like(classes), np.zeros_like(owners)
    nearest = cloud.index().nearest(positions.astype(np.float64), 2 * preset.voxel_size)
    rgb = np.where(nearest[:, None] >= 0, cloud.rgb[nearest], 128).astype(np.uint8)
    if preset.representation == "plain":
        plain = plain_shape(len(channels.class_ids), len(channels.slot_ids))
        gaussians = plain_gaussians(positions, classes, rgb, plain)
        return StructuredScene(gaussians, PlainDecoders(plain), channels, preset.voxel_size)
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
        encoding=preset.encoding,
        twin=preset.instances == "contrastive",
    )
    scene = StructuredScene(anchors, new_decoders(shape, seed), channels, preset.voxel_size)
    if preset.warm_start is not None:
        objects = owners if preset.objects != "none" else None
        warm_start(scene, rgb, objects, viewpoints, preset.warm_start, seed)
    return scene
