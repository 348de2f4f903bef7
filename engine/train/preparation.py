"""From views to a scene that can be trained: what the paper does before the first step.

Consistency-enhanced masks, the semantic point cloud, Algorithm 1, anchors by voxelisation, and the projected targets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..instances import MatchedInstances, match_instances
from ..model.anchors import initial_anchors
from ..model.decoders import Decoders, DecoderShape
from ..model.features import seeded_features
from ..model.structured import LabelChannels, StructuredScene
from ..scene import ClassTable, View
from ..semantics import SemanticEvidence, gather_evidence
from ..semantics.anchor_labels import label_anchors, voxelise
from ..semantics.projection import LabelledPoints, project_labels
from .presets import Preset
from .targets import ViewTargets, view_targets

Progress = Callable[[int, int], None]
"""Called with (done, total); may raise to stop."""


@dataclass(frozen=True, eq=False)
class PreparedLift:
    """What training starts from; ``instances`` and ``evidence`` also go into the result."""

    scene: StructuredScene
    targets: list[ViewTargets]
    evidence: SemanticEvidence
    instances: MatchedInstances


def label_channels(views: Sequence[View], instances: MatchedInstances, least_slots: int) -> LabelChannels:
    """A semantic channel for each class that the masks use, an instance slot for each matched object, and spare slots."""
    class_ids = sorted({segment.class_id for view in views for segment in view.mask.segments} - {0})
    slots = [instance.id for instance in instances.instances]
    return LabelChannels(tuple(class_ids), tuple(slots + [0] * max(0, least_slots - len(slots))))


def starting_scene(
    evidence: SemanticEvidence, instances: MatchedInstances, channels: LabelChannels, preset: Preset, seed: int
) -> StructuredScene:
    """Anchors on the semantic point cloud, decoders drawn from the seed."""
    cloud = evidence.cloud
    positions = voxelise(cloud.xyz, preset.voxel_size)
    classes, owners = label_anchors(cloud, instances.instance_of_point, positions, preset.voxel_size)
    feature = np.zeros((len(positions), preset.features), np.float32)
    if preset.seeded_features:
        nearest = cloud.index().nearest(positions.astype(np.float64), 2 * preset.voxel_size)
        rgb = np.where(nearest[:, None] >= 0, cloud.rgb[nearest], 128).astype(np.uint8)
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
    return StructuredScene(anchors, Decoders(shape, seed), channels, preset.voxel_size)
