"""Rendering a lifted scene from a camera."""

from __future__ import annotations

import numpy as np
import torch

from ..raster import rasterize
from ..scene import Camera
from .gaussians import decode
from .rendering import PanopticRendering
from .structured import StructuredScene


@torch.no_grad()
def render_view(scene: StructuredScene, camera: Camera) -> PanopticRendering:
    """Colour, depth and label coverage of one view, at the camera's size. Spare instance slots are left out."""
    gaussians = decode(scene.anchors, scene.decoders, camera)
    rendering = rasterize(
        gaussians.means,
        gaussians.scales,
        gaussians.quats,
        gaussians.opacities,
        gaussians.colours,
        gaussians.labels,
        torch.from_numpy(camera.camera_to_world).float(),
        torch.from_numpy(camera.K).float(),
        camera.width,
        camera.height,
    )
    alpha = rendering.alpha.numpy()
    assert rendering.labels is not None  # drawn with labels
    labels = rendering.labels.numpy()
    classes = len(scene.channels.class_ids)
    used = sum(slot != 0 for slot in scene.channels.slot_ids)  # spare slots come last
    return PanopticRendering(
        camera=camera,
        image=np.clip(rendering.image.numpy(), 0.0, 1.0),
        alpha=alpha,
        depth=np.where(alpha > 1e-3, rendering.depth.numpy() / np.maximum(alpha, 1e-3), 0.0).astype(np.float32),
        class_coverage=labels[..., :classes],
        instance_coverage=labels[..., classes : classes + used],
        class_ids=scene.channels.class_ids,
        instance_ids=scene.channels.slot_ids[:used],
    )
