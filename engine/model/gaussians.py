"""From anchors to the neural Gaussians that one camera sees."""

from __future__ import annotations

import torch

from ..scene import Camera
from .anchors import Anchors
from .decoders import Decoders
from .decoding.native import decode_natively
from .neural_gaussians import NeuralGaussians
from .torch_decoding import decode_in_torch

NEAR = 0.2
"""Anchors closer to the image plane than this, in metres, are left out (Scaffold-GS's near plane)."""


@torch.no_grad()
def visible_anchors(anchors: Anchors, camera: Camera) -> torch.Tensor:
    """Indices int64 [V] of the anchors whose 3-sigma box touches the picture (Scaffold-GS's pre-filter). Each anchor is
    taken as a sphere of its largest offset scale: offsets are learnt in this unit, and rarely exceed 3."""
    to_camera = torch.from_numpy(camera.world_to_camera).to(anchors.position.device, non_blocking=True)
    right, down, depth = (to_camera[:3, :3] @ anchors.position.double().T + to_camera[:3, 3:]).unbind(0)
    reach = 3.0 * anchors.log_scale[:, :3].amax(dim=1).double().exp() / depth
    u, v = right / depth * camera.fx + camera.cx, down / depth * camera.fy + camera.cy
    across, along = reach * camera.fx, reach * camera.fy
    beside = (u + across > 0) & (u - across < camera.width) & (v + along > 0) & (v - along < camera.height)
    return ((depth > NEAR) & beside).nonzero().squeeze(1)


def decode(
    anchors: Anchors,
    decoders: Decoders,
    camera: Camera,
    *,
    channels: torch.Tensor | None = None,
    known_labels: torch.Tensor | None = None,
    in_torch: bool = False,
) -> NeuralGaussians:
    """Decode the Gaussians of every anchor that ``camera`` can see, and drop those with opacity <= 0. The other
    arguments are those of ``decode_rows``; ``in_torch`` avoids all kernels."""
    position = anchors.position
    centre = torch.from_numpy(camera.centre.copy()).to(position.dtype).to(position.device, non_blocking=True)
    if decoders.decodes_all_anchors:
        visible = torch.arange(len(anchors), device=position.device)
    else:
        visible = visible_anchors(anchors, camera)
    if not in_torch:
        return decode_rows(anchors, decoders, visible, centre, channels=channels, known_labels=known_labels)
    own = decoders.own_decoding(anchors, visible, centre, channels, known_labels)
    return own or decode_in_torch(anchors, decoders, visible, centre, channels, known_labels)


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
    are rows of it without a gradient, and there is no cluster loss."""
    own = decoders.own_decoding(anchors, visible, centre, channels, known_labels)
    if own is not None:
        return own
    is_compiled = anchors.feature.dtype == torch.float32 and anchors.feature.device.type == "cpu"
    is_compiled &= type(decoders) is Decoders  # the kernels know no others
    decode_with = decode_natively if is_compiled else decode_in_torch
    return decode_with(anchors, decoders, visible, centre, channels, known_labels)


def no_labels(anchors: Anchors) -> torch.Tensor:
    """``known_labels`` for a caller that needs no labels: one channel of zeros."""
    return anchors.position.new_zeros(len(anchors) * anchors.gaussians_per_anchor, 1)
