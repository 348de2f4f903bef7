"""Rendering a lifted scene from a camera."""

from __future__ import annotations

import numpy as np
import torch

from ..raster import rasterize
from ..scene import Camera
from .gaussians import decode
from .rendering import PanopticRendering
from .scene_labels import SceneLabels
from .structured import StructuredScene


@torch.no_grad()
def render_view(scene: StructuredScene, camera: Camera, labels: SceneLabels | None = None) -> PanopticRendering:
    """Colour, depth and label coverage of one view, at the camera's size. Spare instance slots are left out.

    ``labels``: what ``scene_labels`` made of this very scene, which saves decoding them for each view.
    """
    known = None if labels is None else labels.probabilities
    gaussians = decode(scene.anchors, scene.decoders, camera, known_labels=known)
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
    coverage = rendering.labels.numpy()
    classes, slot_ids = len(scene.channels.class_ids), scene.channels.slot_ids
    used = [column for column, slot in enumerate(slot_ids) if slot]
    if labels is None and used != list(range(len(used))):
        coverage = coverage[..., [*range(classes), *(classes + column for column in used)]]
    return PanopticRendering(
        camera=camera,
        image=rendering.image.clamp_(0.0, 1.0).numpy(),
        alpha=alpha,
        depth=np.divide(rendering.depth.numpy(), alpha, out=np.zeros_like(alpha), where=alpha > 1e-3),
        class_coverage=coverage[..., :classes],
        instance_coverage=coverage[..., classes : classes + len(used)],
        class_ids=scene.channels.class_ids,
        instance_ids=tuple(slot_ids[column] for column in used),
    )
