"""A scene of random anchors before a camera, untrained: what the tests of labels share."""

import numpy as np
import torch

from engine.model.anchors import initial_anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.model.gaussians import decode
from engine.model.structured import LabelChannels, StructuredScene
from engine.raster import rasterize
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


def mean_depth(scene: StructuredScene, camera: Camera) -> np.ndarray:
    """The planar depth [H, W] in metres that blending all Gaussians of a pixel gives."""
    with torch.no_grad():
        drawn = decode(scene.anchors, scene.decoders, camera)
        pose, lens = (torch.from_numpy(each).float() for each in (camera.camera_to_world, camera.K))
        shapes = drawn.means, drawn.scales, drawn.quats, drawn.opacities, drawn.colours
        picture = rasterize(*shapes, None, pose, lens, *camera.size)
    return (picture.depth / picture.alpha.clamp_min(1e-3)).numpy()
