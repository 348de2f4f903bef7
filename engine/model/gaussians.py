"""From anchors to the neural Gaussians that one camera sees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ..machine.compiled import compiled
from ..scene import Camera
from .anchors import Anchors
from .decoders import Decoders
from .decoding.native import decode_natively
from .neural_gaussians import NeuralGaussians
from .torch_decoding import decode_in_torch

NEAR = 0.2
"""Anchors closer to the image plane than this, in metres, are left out (Scaffold-GS's near plane)."""


def visible_anchors(anchors: Anchors, camera: Camera) -> torch.Tensor:
    """Indices int64 [V] of the anchors whose 3-sigma box touches the picture (Scaffold-GS's pre-filter).

    Each anchor is taken as a sphere of its largest offset scale: offsets are learnt in this unit, and rarely exceed 3.
    """
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    rows = _rows_in_picture(
        anchors.position.numpy(force=True),
        anchors.log_scale.numpy(force=True),
        camera.world_to_camera,
        intrinsics,
        camera.width,
        camera.height,
    )
    return torch.from_numpy(rows).to(anchors.position.device)


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


def decode(
    anchors: Anchors,
    decoders: Decoders,
    camera: Camera,
    *,
    channels: torch.Tensor | None = None,
    known_labels: torch.Tensor | None = None,
) -> NeuralGaussians:
    """Decode the Gaussians of every anchor that ``camera`` can see, and drop those with opacity <= 0. The other
    arguments are those of ``decode_rows``."""
    centre = torch.from_numpy(camera.centre.copy()).to(anchors.position)
    if decoders.decodes_all_anchors:
        visible = torch.arange(len(anchors))
    else:
        visible = visible_anchors(anchors, camera)
    return decode_rows(anchors, decoders, visible, centre, channels=channels, known_labels=known_labels)


def decode_rows(
    anchors: Anchors,
    decoders: Decoders,
    visible: torch.Tensor,
    centre: torch.Tensor,
    *,
    channels: torch.Tensor | None = None,
    known_labels: torch.Tensor | None = None,
) -> NeuralGaussians:
    """Decode the anchors in rows ``visible`` int64 [V] (without repetitions) as seen from ``centre`` [3] metres.

    ``channels`` int64 [M]: semantic channel of each anchor's class, -1 if it has none, for the cluster loss.
    ``known_labels`` float32 [M * k, L]: what every Gaussian shows, decoded earlier (see ``SceneLabels``). Then labels
    are rows of it without a gradient, and there is no cluster loss.
    """
    own = decoders.own_decoding(anchors, visible, centre, channels, known_labels)
    if own is not None:
        return own
    is_compiled = anchors.feature.dtype == torch.float32 and anchors.feature.device.type == "cpu"
    is_compiled &= type(decoders) is Decoders  # the kernels know no others
    decode_with = decode_natively if is_compiled else decode_in_torch
    return decode_with(anchors, decoders, visible, centre, channels, known_labels)


def no_labels(anchors: Anchors) -> torch.Tensor:
    """``known_labels`` for a caller that needs no labels: one channel of zeros."""
    return torch.zeros(len(anchors) * anchors.gaussians_per_anchor, 1)
