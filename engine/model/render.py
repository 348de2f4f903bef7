"""Rendering a lifted scene from a camera."""

from __future__ import annotations

import numpy as np
import torch

from ..raster import rasterize
from ..scene import Camera
from .gaussians import decode
from .rendering import PanopticRendering
from .scene_labels import SceneLabels, scene_labels, shown_probabilities
from .structured import StructuredScene


@torch.no_grad()
def render_view(scene: StructuredScene, camera: Camera, labels: SceneLabels | None = None) -> PanopticRendering:
    """Colour, depth and label coverage of one view, at the camera's size.

    ``labels``: what ``scene_labels`` made of this very scene, which saves decoding them for each view.
    """
    if labels is None and scene.voted is not None:
        labels = scene_labels(scene)
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
    classes, coverage = len(scene.channels.class_ids), rendering.labels
    if labels is None:
        coverage = shown_probabilities(coverage[..., :classes], coverage[..., classes:], scene.channels)
    return PanopticRendering(
        camera=camera,
        image=rendering.image.clamp_(0.0, 1.0).numpy(),
        alpha=alpha,
        depth=np.divide(rendering.depth.numpy(), alpha, out=np.zeros_like(alpha), where=alpha > 1e-3),
        class_coverage=coverage[..., :classes].numpy(),
        instance_coverage=coverage[..., classes:].numpy(),
        class_ids=scene.channels.class_ids,
        instance_ids=scene.channels.shown_ids,
    )
