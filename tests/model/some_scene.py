"""A scene of random anchors before a camera, untrained: what the tests of labels share."""

from __future__ import annotations

import numpy as np

from engine.model.anchors import initial_anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.model.structured import LabelChannels, StructuredScene
from engine.scene import Camera

CAMERA = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
SHAPE = DecoderShape(8, 4, 3, 5, distance_input=False, label_view_input=False)
CLASS_IDS = (2, 5, 7)
GAUSSIANS = 80 * SHAPE.gaussians_per_anchor


def some_scene(
    slot_ids: tuple[int, ...], shape: DecoderShape = SHAPE, class_of_slot: tuple[int, ...] = ()
) -> StructuredScene:
    random = np.random.default_rng(0)
    positions = random.uniform([-1, -1, 1.5], [1, 1, 3], (80, 3)).astype(np.float32)
    feature = random.normal(size=(80, 8)).astype(np.float32)
    anchors = initial_anchors(positions, np.ones(80, int), gaussians_per_anchor=4, feature=feature, voxel_size=0.1)
    channels = LabelChannels(CLASS_IDS, slot_ids, class_of_slot)
    return StructuredScene(anchors, Decoders(shape, 3), channels, 0.1)
