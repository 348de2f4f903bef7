"""The losses of the paper's section "Loss Functions" but for those of label pictures (``label_losses``).

Their weights are ``LossWeights`` (``presets``); ``Trainer._losses`` multiplies and adds.
"""

from __future__ import annotations

import torch

from .similarity import PhotoMoments, compare


def reconstruction_loss(
    image: torch.Tensor,
    photo: PhotoMoments,
    scales: torch.Tensor,
    *,
    photo_weight: float,
    ssim_weight: float,
    volume_weight: float,
) -> torch.Tensor:
    """L_recon: L1 + lambda_ssim (1 - SSIM) + lambda_vol sum of prod(scales), of a picture float32 [H, W, 3] in [0, 1]
    and scales [N, 3] in metres. ``photo_weight`` (1 in the paper) is that of the first two."""
    volume = (scales[:, 0] * scales[:, 1] * scales[:, 2]).sum()
    picture = compare(image, photo, 1.0, -ssim_weight) + ssim_weight
    return photo_weight * picture + volume_weight * volume
