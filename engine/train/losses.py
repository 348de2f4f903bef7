"""The losses of the paper's section "Loss Functions". Images are float32 [H, W, ...] torch tensors."""

from __future__ import annotations

import torch
from torch.nn import functional

TINY = 1e-8


def _gaussian_window(size: int = 11, sigma: float = 1.5) -> torch.Tensor:
    x = torch.arange(size, dtype=torch.float32) - size // 2
    window = torch.exp(-(x**2) / (2 * sigma**2))
    return window / window.sum()


def structural_similarity(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Mean SSIM of two images [H, W, 3] in [0, 1]: 11x11 Gaussian window of sigma 1.5, zero padding, K1 = 0.01, K2 = 0.03.

    The five blurred moments go through one separable convolution.
    """
    window = _gaussian_window()
    maps = torch.cat([a, b, a * a, b * b, a * b], dim=2).permute(2, 0, 1)[:, None]
    blurred = functional.conv2d(maps, window.view(1, 1, -1, 1), padding=(5, 0))
    blurred = functional.conv2d(blurred, window.view(1, 1, 1, -1), padding=(0, 5)).view(5, 3, *a.shape[:2])
    mean_a, mean_b, square_a, square_b, product = blurred
    variance_a, variance_b = square_a - mean_a**2, square_b - mean_b**2
    covariance = product - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    ssim = ssim / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))
    return ssim.mean()


def reconstruction_loss(
    image: torch.Tensor, photo: torch.Tensor, scales: torch.Tensor, *, ssim_weight: float, volume_weight: float
) -> torch.Tensor:
    """L_recon: L1 + lambda_ssim (1 - SSIM) + lambda_vol sum of prod(scales), scales [N, 3] in metres."""
    l1 = (image - photo).abs().mean()
    return l1 + ssim_weight * (1 - structural_similarity(image, photo)) + volume_weight * scales.prod(dim=1).sum()


def label_loss(coverage: torch.Tensor, alpha: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """-log of the rendered probability of the target label, mean over the pixels that have one.

    ``coverage`` [H, W, C], blended probabilities; ``alpha`` [H, W], detached here, since only the reconstruction loss may
    reach opacity; ``target`` int64 [H, W], -1 where no label is known. 0 when there is no target at all.
    """
    known = target >= 0
    if not bool(known.any()):
        return coverage.sum() * 0.0
    rows = known.nonzero(as_tuple=True)
    probability = coverage[rows[0], rows[1], target[known]] / (alpha.detach()[known] + TINY)
    return -torch.log(probability + TINY).mean()


def instance_loss(
    coverage: torch.Tensor, alpha: torch.Tensor, assigned: torch.Tensor, matched: torch.Tensor
) -> torch.Tensor:
    """L_ins: the linear assignment's target and the 3D match's target added up, mean over pixels that have either.

    ``assigned`` and ``matched`` int64 [H, W] hold slots, -1 = none.
    """
    supervised = (assigned >= 0) | (matched >= 0)
    count = int(supervised.sum())
    if not count:
        return coverage.sum() * 0.0
    total = coverage.new_zeros(())
    for target in (assigned, matched):
        known = int((target >= 0).sum())
        if known:
            total = total + label_loss(coverage, alpha, target) * (known / count)
    return total


def cluster_loss(class_logits: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """L_cluster over visible initial anchors: ``class_logits`` [V, k, C], ``target`` int64 [V] with -1 = no believed label.

    All k Gaussians of an anchor count, drawn or not (equation "Cluster Loss").
    """
    known = target >= 0
    if not bool(known.any()):
        return class_logits.sum() * 0.0
    logits = class_logits[known]
    k = logits.shape[1]
    return functional.cross_entropy(logits.reshape(-1, logits.shape[2]), target[known].repeat_interleave(k))
