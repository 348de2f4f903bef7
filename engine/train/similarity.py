"""Structural similarity as a loss: 11x11 Gaussian window of sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


@lru_cache(maxsize=32)
def _blur_matrix(size: int) -> torch.Tensor:
    """The window as a banded matrix [size, size]: row i holds the weights of output i. Zeros fall off the ends.

    Two matrix products blur a picture, and blur its gradient back. On a CPU that beats convolution layers, whose
    backward pass is made for many channels, by an order of magnitude.
    """
    position = torch.arange(size)
    distance = (position[:, None] - position[None, :]).abs()
    weights = torch.exp(-(distance**2) / (2 * SIGMA**2)) * (distance <= WINDOW // 2)
    offsets = torch.arange(WINDOW) - WINDOW // 2
    return weights / torch.exp(-(offsets**2) / (2 * SIGMA**2)).sum()


def _blur(planes: torch.Tensor) -> torch.Tensor:
    """Planes [N, H, W] blurred along both axes."""
    height, width = planes.shape[1:]
    return _blur_matrix(height) @ planes @ _blur_matrix(width).T


@dataclass(frozen=True)
class PhotoMoments:
    """What SSIM needs of the photo, computed once: ``planes`` [3, H, W], blurred ``mean`` and ``variance`` of them."""

    planes: torch.Tensor
    mean: torch.Tensor
    variance: torch.Tensor

    @classmethod
    def of(cls, photo: torch.Tensor) -> PhotoMoments:
        """Moments of a photo float32 [H, W, 3] in [0, 1]."""
        planes = photo.permute(2, 0, 1).contiguous()
        mean = _blur(planes)
        return cls(planes, mean, _blur(planes * planes) - mean**2)


def structural_similarity(image: torch.Tensor, photo: PhotoMoments) -> torch.Tensor:
    """Mean SSIM of ``image`` [H, W, 3] in [0, 1] and a photo."""
    planes = image.permute(2, 0, 1)
    blurred = _blur(torch.cat([planes, planes * planes, planes * photo.planes]))
    mean, square, product = blurred[:3], blurred[3:6], blurred[6:]
    mean_square, mean_product = mean * mean, mean * photo.mean
    variance, covariance = square - mean_square, product - mean_product
    ssim = (2 * mean_product + C1) * (2 * covariance + C2)
    ssim = ssim / ((mean_square + photo.mean**2 + C1) * (variance + photo.variance + C2))
    return ssim.mean()
