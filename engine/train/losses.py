"""The losses of the paper's section "Loss Functions" but for those of label pictures (``label_losses``)."""

from __future__ import annotations

import torch
from torch.nn import functional

from .similarity import PhotoMoments, compare


def reconstruction_loss(
    image: torch.Tensor, photo: PhotoMoments, scales: torch.Tensor, *, ssim_weight: float, volume_weight: float
) -> torch.Tensor:
    """L_recon: L1 + lambda_ssim (1 - SSIM) + lambda_vol sum of prod(scales), of a picture float32 [H, W, 3] in [0, 1]
    and scales [N, 3] in metres."""
    volume = (scales[:, 0] * scales[:, 1] * scales[:, 2]).sum()
    return compare(image, photo, 1.0, -ssim_weight) + ssim_weight + volume_weight * volume


def cluster_loss(class_logits: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_cluster over visible initial anchors: ``class_logits`` [V, k, C], ``target`` int64 [V] with -1 = no label.

    All k Gaussians of an anchor count, drawn or not (equation "Cluster Loss").
    """
    if not bool((target >= 0).any()):
        return class_logits.sum() * 0.0
    k = class_logits.shape[1]
    return functional.cross_entropy(
        class_logits.reshape(-1, class_logits.shape[2]), target.repeat_interleave(k), ignore_index=-1
    )
