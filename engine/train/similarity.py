"""Structural similarity as a loss: 11x11 Gaussian window of sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2; and
L1, which is measured on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.autograd.function import once_differentiable

from ..machine import memory
from ..machine.threads import parallel_for, worker_count
from .similarity_kernels import WEIGHTS, Found, Pictures, compare_strips, scratch_size, strip_count


def _blur(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """A picture [H, W, 3] blurred by the window, with zeros around it."""
    window = np.array([*reversed(WEIGHTS), *WEIGHTS[1:]], np.float32)
    return cv2.sepFilter2D(picture, -1, window, window, borderType=cv2.BORDER_CONSTANT).astype(np.float32, copy=False)


@dataclass(frozen=True)
class PhotoMoments:
    """A photo and what SSIM needs of it, computed once: its blurred mean and variance; float32 [H, W, 3] each."""

    values: NDArray[np.float32]
    mean: NDArray[np.float32]
    variance: NDArray[np.float32]

    @classmethod
    def of(cls, photo: torch.Tensor) -> PhotoMoments:
        """Moments of a photo float32 [H, W, 3] in [0, 1]."""
        values = np.ascontiguousarray(photo.numpy())
        mean = _blur(values)
        return cls(values, mean, _blur(values * values) - mean**2)


class _Comparison(torch.autograd.Function):
    """l1_weight * L1 + ssim_weight * SSIM of a picture and a photo, with the gradient made on the way."""

    @staticmethod
    def forward(
        ctx: Any, image: torch.Tensor, photo: PhotoMoments, l1_weight: float, ssim_weight: float
    ) -> torch.Tensor:
        if image.shape != photo.values.shape:
            raise ValueError(f"the picture is {tuple(image.shape)}, the photo {photo.values.shape}")
        height, width, channels = image.shape
        length, count, workers = width * channels, image.numel(), worker_count()
        pictures = (image.detach().contiguous().numpy(), photo.values, photo.mean, photo.variance)
        rows = Pictures(*(picture.reshape(height, length) for picture in pictures))
        weights = np.array([l1_weight / count, ssim_weight / count], np.float32)
        gradient = memory.empty((height, length), np.float32)
        found = Found(gradient, np.zeros((strip_count(height), 2)))
        scratch = memory.empty((workers, scratch_size(length)), np.float32)
        parallel_for(workers, compare_strips, rows, weights, found, scratch)
        ctx.save_for_backward(torch.from_numpy(gradient).view(image.shape))
        difference, similarity = found.sums.sum(axis=0) / count
        return image.new_tensor(l1_weight * difference + ssim_weight * similarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * gradients[0], None, None, None


def compare(image: torch.Tensor, photo: PhotoMoments, l1_weight: float, ssim_weight: float) -> torch.Tensor:
    """``l1_weight`` * mean |difference| + ``ssim_weight`` * mean SSIM of ``image`` float32 [H, W, 3] in [0, 1] and a
    photo. Differentiable once in ``image``. Raises ValueError when sizes differ."""
    result: torch.Tensor = _Comparison.apply(image, photo, l1_weight, ssim_weight)
    return result
