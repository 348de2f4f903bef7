"""From anchors to the neural Gaussians that one camera sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..raster.compiled import compiled
from ..scene import Camera
from .anchors import Anchors
from .decoders import Decoders
from .rows import take_rows

NEAR = 0.2
"""Anchors closer to the image plane than this, in metres, are left out (Scaffold-GS's near plane)."""


@dataclass(frozen=True)
class NeuralGaussians:
    """N Gaussians with opacity > 0, decoded for one camera; float32.

    ``means`` [N, 3] metres, ``scales`` [N, 3] standard deviations in metres, ``quats`` [N, 4] wxyz (not normalised),
    ``opacities`` [N] in (0, 1], ``colours`` [N, 3], ``labels`` [N, C + S]: class probabilities, then instance-slot
    probabilities. ``visible`` int64 [V] are the anchors decoded, ``all_opacities`` [V, k] their opacities in
    (-1, 1), ``kept`` int64 [N] index into the flattened [V * k]. ``class_logits`` [V, k, C] serves the cluster loss.
    """

    means: torch.Tensor
    scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor
    labels: torch.Tensor
    visible: torch.Tensor
    all_opacities: torch.Tensor
    kept: torch.Tensor
    class_logits: torch.Tensor


def visible_anchors(anchors: Anchors, camera: Camera) -> torch.Tensor:
    """Indices int64 [V] of the anchors whose 3-sigma box touches the picture (Scaffold-GS's pre-filter).

    Each anchor counts as a sphere of its largest offset scale: offsets are learnt in units of it, and rarely exceed 3.
    """
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    rows = _rows_in_picture(
        anchors.position.numpy(),
        anchors.log_scale.detach().numpy(),
        camera.world_to_camera,
        intrinsics,
        camera.width,
        camera.height,
    )
    return torch.from_numpy(rows)


@compiled
def _rows_in_picture(position: Any, log_scale: Any, to_camera: Any, intrinsics: Any, width: Any, height: Any) -> Any:
    """The loop behind ``visible_anchors``: one pass over position [M, 3] and log_scale [M, 6]."""
    fx, fy, cx, cy = intrinsics
    rows = np.empty(len(position), np.int64)
    count = 0
    for row in range(len(position)):
        x, y, z = position[row, 0], position[row, 1], position[row, 2]
        depth = to_camera[2, 0] * x + to_camera[2, 1] * y + to_camera[2, 2] * z + to_camera[2, 3]
        if depth <= NEAR:
            continue
        reach = 3.0 * math.exp(max(log_scale[row, 0], log_scale[row, 1], log_scale[row, 2])) / depth
        right = to_camera[0, 0] * x + to_camera[0, 1] * y + to_camera[0, 2] * z + to_camera[0, 3]
        down = to_camera[1, 0] * x + to_camera[1, 1] * y + to_camera[1, 2] * z + to_camera[1, 3]
        u, v = right / depth * fx + cx, down / depth * fy + cy
        across, along = reach * fx, reach * fy
        if u + across > 0 and u - across < width and v + along > 0 and v - along < height:
            rows[count] = row
            count += 1
    return rows[:count].copy()


def decode(anchors: Anchors, decoders: Decoders, camera: Camera) -> NeuralGaussians:
    """Decode the Gaussians of every anchor that ``camera`` can see; those with opacity <= 0 are dropped."""
    centre = torch.from_numpy(camera.centre.copy()).float()
    return decode_rows(anchors, decoders, visible_anchors(anchors, camera), centre)


def decode_rows(anchors: Anchors, decoders: Decoders, visible: torch.Tensor, centre: torch.Tensor) -> NeuralGaussians:
    """Decode the anchors of rows ``visible`` int64 [V] as seen from ``centre`` [3] metres."""
    position = anchors.position.index_select(0, visible)
    feature = take_rows(anchors.feature, visible)
    seen = decoders.view_input(feature, position, centre)
    k = anchors.gaussians_per_anchor

    opacity = torch.tanh(decoders.opacity(seen))
    kept = (opacity.detach().reshape(-1) > 0).nonzero().squeeze(1)
    owner = kept // k
    shape = take_rows(decoders.covariance(seen).view(-1, 7), kept)
    colour = torch.sigmoid(take_rows(decoders.colour(seen).view(-1, 3), kept))
    owner_scale = take_rows(anchors.log_scale, visible).exp().index_select(0, owner)
    offset = take_rows(take_rows(anchors.offset, visible).view(-1, 3), kept)

    class_logits, instance_logits = decoders.label_logits(feature, seen)
    labels = torch.cat(
        [torch.softmax(take_rows(logits.flatten(0, 1), kept), dim=1) for logits in (class_logits, instance_logits)],
        dim=1,
    )
    return NeuralGaussians(
        means=position.index_select(0, owner) + offset * owner_scale[:, :3],
        scales=owner_scale[:, 3:] * torch.sigmoid(shape[:, :3]),
        quats=shape[:, 3:],
        opacities=take_rows(opacity.reshape(-1), kept),
        colours=colour,
        labels=labels,
        visible=visible,
        all_opacities=opacity,
        kept=kept,
        class_logits=class_logits,
    )
