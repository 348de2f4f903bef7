"""From anchors to the neural Gaussians that one camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..scene import Camera
from .anchors import Anchors
from .decoders import Decoders

NEAR = 0.2
"""Anchors closer to the image plane than this, in metres, are left out (Scaffold-GS's near plane)."""


@dataclass(frozen=True)
class NeuralGaussians:
    """N Gaussians with opacity > 0, decoded for one camera; float32.

    ``means`` [N, 3] metres, ``scales`` [N, 3] standard deviations in metres, ``quats`` [N, 4] wxyz (not normalised),
    ``opacities`` [N] in (0, 1], ``colours`` [N, 3], ``labels`` [N, C + S]: class probabilities, then instance-slot
    probabilities, or None. ``visible`` int64 [V] are the anchors decoded, ``all_opacities`` [V, k] their opacities in (-1, 1),
    ``kept`` int64 [N] index into the flattened [V * k]. ``class_logits`` [V, k, C] serves the cluster loss.
    """

    means: torch.Tensor
    scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor
    labels: torch.Tensor | None
    visible: torch.Tensor
    all_opacities: torch.Tensor
    kept: torch.Tensor
    class_logits: torch.Tensor | None


def visible_anchors(anchors: Anchors, camera: Camera) -> torch.Tensor:
    """Indices int64 [V] of the anchors whose 3-sigma box touches the picture (Scaffold-GS's pre-filter).

    Each anchor counts as a sphere of its largest offset scale, which bounds where its Gaussians can be.
    """
    pose = torch.from_numpy(camera.camera_to_world).float()
    local = (anchors.position - pose[:3, 3]) @ pose[:3, :3]
    depth = local[:, 2]
    reach = 3.0 * anchors.log_scale.detach()[:, :3].max(dim=1).values.exp()
    safe = depth.clamp_min(NEAR)
    x = local[:, 0] / safe * camera.fx + camera.cx
    y = local[:, 1] / safe * camera.fy + camera.cy
    rx, ry = reach / safe * camera.fx, reach / safe * camera.fy
    inside = (depth > NEAR) & (x + rx > 0) & (x - rx < camera.width) & (y + ry > 0) & (y - ry < camera.height)
    return inside.nonzero().squeeze(1)


def decode(anchors: Anchors, decoders: Decoders, camera: Camera, *, with_labels: bool = True) -> NeuralGaussians:
    """Decode the Gaussians of every anchor that ``camera`` can see; those with opacity <= 0 are dropped."""
    centre = torch.from_numpy(camera.centre.copy()).float()
    return decode_rows(anchors, decoders, visible_anchors(anchors, camera), centre, with_labels=with_labels)


def decode_rows(
    anchors: Anchors, decoders: Decoders, visible: torch.Tensor, centre: torch.Tensor, *, with_labels: bool = True
) -> NeuralGaussians:
    """Decode the anchors of rows ``visible`` int64 [V] as seen from ``centre`` [3] metres."""
    position = anchors.position[visible]
    feature = anchors.feature[visible]
    seen = decoders.view_input(feature, position, centre)
    k = anchors.gaussians_per_anchor

    opacity = torch.tanh(decoders.opacity(seen))
    kept = (opacity.detach().reshape(-1) > 0).nonzero().squeeze(1)
    owner = kept // k
    shape = decoders.covariance(seen).view(-1, 7)[kept]
    colour = torch.sigmoid(decoders.colour(seen).view(-1, 3)[kept])
    scale = anchors.log_scale[visible].exp()
    owner_scale = scale[owner]
    offset = anchors.offset[visible].view(-1, 3)[kept]

    labels, class_logits = None, None
    if with_labels:
        class_logits, instance_logits = decoders.label_logits(feature, seen)
        labels = torch.cat(
            [
                torch.softmax(class_logits.reshape(len(visible) * k, -1)[kept], dim=1),
                torch.softmax(instance_logits.reshape(len(visible) * k, -1)[kept], dim=1),
            ],
            dim=1,
        )
    return NeuralGaussians(
        means=position[owner] + offset * owner_scale[:, :3],
        scales=owner_scale[:, 3:] * torch.sigmoid(shape[:, :3]),
        quats=shape[:, 3:],
        opacities=opacity.reshape(-1)[kept],
        colours=colour,
        labels=labels,
        visible=visible,
        all_opacities=opacity,
        kept=kept,
        class_logits=class_logits,
    )
