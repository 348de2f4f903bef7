"""The losses of the paper's section "Loss Functions". Images are float32 [H, W, ...] torch tensors."""

from __future__ import annotations

from typing import Any

import torch

from .similarity import PhotoMoments, structural_similarity

TINY = 1e-8


def reconstruction_loss(
    image: torch.Tensor,
    photo: torch.Tensor,
    moments: PhotoMoments,
    scales: torch.Tensor,
    *,
    ssim_weight: float,
    volume_weight: float,
) -> torch.Tensor:
    """L_recon: L1 + lambda_ssim (1 - SSIM) + lambda_vol sum of prod(scales), scales [N, 3] in metres."""
    l1 = (image - photo).abs().mean()
    volume = (scales[:, 0] * scales[:, 1] * scales[:, 2]).sum()
    return l1 + ssim_weight * (1 - structural_similarity(image, moments)) + volume_weight * volume


class _TargetNegativeLog(torch.autograd.Function):
    """Weighted sum of -log(coverage[pixel, channel] / alpha[pixel] + TINY) over chosen (pixel, channel) pairs.

    One dense gradient is written once, where slices, divisions and logarithms of whole label pictures would write many.
    """

    @staticmethod
    def forward(
        ctx: Any, coverage: torch.Tensor, alpha: torch.Tensor, place: torch.Tensor, weight: torch.Tensor
    ) -> torch.Tensor:
        chosen = coverage.reshape(-1).index_select(0, place)
        visible = alpha.reshape(-1).index_select(0, place // coverage.shape[-1]) + TINY
        probability = chosen / visible + TINY
        ctx.save_for_backward(place, -weight / (probability * visible))
        ctx.shape = coverage.shape
        return -(weight * torch.log(probability)).sum()

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        place, slope = ctx.saved_tensors
        gradient = slope.new_zeros(ctx.shape.numel())
        gradient.index_add_(0, place, slope * gradients[0])
        return gradient.view(ctx.shape), None, None, None


def label_loss(
    coverage: torch.Tensor, alpha: torch.Tensor, first: int, targets: tuple[torch.Tensor, ...]
) -> torch.Tensor:
    """-log of the rendered probability of the target label, added over ``targets``, mean over pixels that have any.

    ``coverage`` [H, W, C] holds blended probabilities, of which those from channel ``first`` on count; ``alpha`` [H, W]
    only divides: no gradient reaches it, since only the reconstruction loss may reach opacity. A target is int64
    [H, W]: channel - first, or -1 where no label is known. The semantic loss has one target, L_ins two (linear
    assignment and M_match). 0 when there is no target at all.
    """
    known = targets[0] >= 0
    for target in targets[1:]:
        known = known | (target >= 0)
    weight = 1.0 / max(int(known.sum()), 1)
    places = []
    for target in targets:
        flat = target.reshape(-1)
        pixel = (flat >= 0).nonzero().squeeze(1)
        places.append(pixel * coverage.shape[-1] + first + flat.index_select(0, pixel).long())
    place = torch.cat(places)
    loss: torch.Tensor = _TargetNegativeLog.apply(coverage, alpha.detach(), place, torch.full((len(place),), weight))
    return loss
