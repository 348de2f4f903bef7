"""Decodes anchors to the neural Gaussians that one camera sees."""

from __future__ import annotations

import torch

from ..raster.conventions import USUAL_DISTANCE
from ..scene import Camera
from .anchors import Anchors, AnchorsInView
from .decoders import Decoders
from .decoding.native import decode_natively
from .neural_gaussians import NeuralGaussians
from .torch_decoding import decode_in_torch

NEAR = 0.2
"""Anchors closer to the image plane than this, in metres, are left out (Scaffold-GS's near plane)."""


@torch.no_grad()
def visible_anchors(anchors: Anchors, camera: Camera) -> torch.Tensor:
    """Return the indices, int64 [V], of anchors whose 3-sigma box touches the picture (Scaffold-GS's pre-filter). Each
    counts as a sphere of its largest offset scale: learnt offsets are in this unit, and rarely exceed 3."""
    to_camera = torch.from_numpy(camera.world_to_camera).to(anchors.position.device, non_blocking=True)
    right, down, depth = (to_camera[:3, :3] @ anchors.position.double().T + to_camera[:3, 3:]).unbind(0)
    if camera.projection == "orthographic":  # the rasteriser cuts at the near plane
        depth = torch.ones_like(depth)
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
    channels: torch.Tensor | None = None,  # int64 [M]
    known_labels: torch.Tensor | None = None,  # [M * k, L]
    in_torch: bool = False,
) -> NeuralGaussians:
    """Decode the Gaussians of all anchors that ``camera`` can see, and drop those with opacity <= 0. ``channels`` [M]
    of classes add the cluster loss; ``known_labels`` replace decoded labels; ``in_torch``: no kernels."""
    position = anchors.position
    centre = torch.from_numpy(camera.centre.copy()).to(position.dtype).to(position.device, non_blocking=True)
    if decoders.decodes_all_anchors:
        visible = torch.arange(len(anchors), device=position.device)
    else:
        visible = visible_anchors(anchors, camera)
    if camera.projection == "orthographic":  # each is seen from along the axis; no kernel knows that
        ahead = torch.from_numpy(camera.camera_to_world[:3, 2].copy()).to(position)
        centre, in_torch = position.index_select(0, visible) - USUAL_DISTANCE * ahead, True
    given = AnchorsInView(anchors, visible, centre, channels, known_labels)
    if not in_torch:
        return decode_rows(given, decoders)
    return decoders.own_decoding(given) or decode_in_torch(given, decoders)


def decode_rows(given: AnchorsInView, decoders: Decoders) -> NeuralGaussians:
    """Decode the anchors in ``given``. If it has ``known_labels``, labels are copied from these, and L_cluster is 0."""
    own = decoders.own_decoding(given)
    if own is not None:
        return own
    feature = given.anchors.feature
    is_compiled = feature.dtype == torch.float32 and feature.device.type == "cpu"
    is_compiled &= type(decoders) is Decoders  # the kernels know no others
    return decode_natively(given, decoders) if is_compiled else decode_in_torch(given, decoders)


def no_labels(anchors: Anchors) -> torch.Tensor:
    """Return ``known_labels`` for callers that need no labels: a single channel of zeros."""
    return anchors.position.new_zeros(len(anchors) * anchors.gaussians_per_anchor, 1)
