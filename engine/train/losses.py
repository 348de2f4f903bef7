"""The losses of picture, size and depth; those of labels are in ``label_losses`` (the paper's "Loss Functions").

Their weights are ``LossWeights`` (``engine/presets/preset.py``); ``Trainer._losses`` computes the weighted sum.
"""

from __future__ import annotations

import torch

from .similarity import PhotoMoments, compare

NEAR = 0.5
"""Metres: errors at smaller depths count as much as at this depth."""
NOISY = 4.0
"""Metres: at this depth a sensor's noise, which grows as depth squared, halves the weight of a pixel."""


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
    and scales [N, 3] in metres. ``photo_weight`` (1 in the paper) is the weight of the first two terms."""
    volume = (scales[:, 0] * scales[:, 1] * scales[:, 2]).sum()
    picture = compare(image, photo, 1.0, -ssim_weight) + ssim_weight
    return photo_weight * picture + volume_weight * volume


def depth_loss(depth: torch.Tensor, alpha: torch.Tensor, sensor: torch.Tensor) -> torch.Tensor:
    """The depth loss. It is ours: the paper supervises the geometry by pictures alone.

    Mean over the pixels with depth of min(1, (|D - alpha d| + (1 - alpha) d / 2) / max(d, NEAR)), weighted by the
    sensor's noise; 0 where no pixel has depth.

    ``depth`` D float32 [H, W] is the unnormalised rendered depth in metres, ``alpha`` [H, W] the coverage, ``sensor`` d
    [H, W] metres, 0 = none. The limit of 1 makes it robust: an error as large as the depth itself counts once.
    """
    known = sensor > 0
    if not bool(known.any()):
        return depth.sum() * 0.0
    gap = (depth - alpha * sensor).abs() + 0.5 * (1.0 - alpha) * sensor
    weight = known / (1.0 + (sensor / NOISY) ** 2)
    return ((gap / sensor.clamp_min(NEAR)).clamp_max(1.0) * weight).sum() / weight.sum()
