"""The structural similarity index (SSIM) as a loss, and L1, computed together. SSIM's window is a Gaussian of 11x11
pixels and sigma 1.5, with zeros around the picture; C1 = 0.01^2, C2 = 0.03^2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.autograd.function import once_differentiable

from ..machine import memory
from ..machine.compiled import Array, contracted
from ..machine.threads import parallel_for, worker_count

WINDOW, SIGMA = 11, 1.5
REACH = WINDOW // 2
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
ONE, TWO = np.float32(1), np.float32(2)
STRIP_ROWS = 48
"""Rows that a thread compares at once. The intermediate pictures of a strip stay in the processor's cache, and the
strips depend only on the picture, so that sums have the same bits for any number of threads."""

WINDOW_WEIGHTS = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F)


def _blur(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a picture [H, W, 3] convolved with SSIM's Gaussian window, with zeros around the picture."""
    blurred = cv2.sepFilter2D(picture, -1, WINDOW_WEIGHTS, WINDOW_WEIGHTS, borderType=cv2.BORDER_CONSTANT)
    return blurred.astype(np.float32, copy=False)


def photo_values(photo: PhotoMoments | torch.Tensor) -> torch.Tensor:
    """Return a photo's colours, float32 [H, W, 3] in [0, 1], on the photo's device, also if stored as uint8."""
    return torch.from_numpy(photo.values) if isinstance(photo, PhotoMoments) else photo.float() / 255.0


@dataclass(frozen=True)
class PhotoMoments:
    """A photo and what SSIM needs of it in every step: blurred mean and variance; all float32 [H, W, 3]."""

    values: NDArray[np.float32]
    mean: NDArray[np.float32]
    variance: NDArray[np.float32]

    @classmethod
    def of(cls, photo: torch.Tensor) -> PhotoMoments:
        """Compute the moments of a photo, float32 [H, W, 3] in [0, 1]."""
        values = np.ascontiguousarray(photo.numpy())
        mean = _blur(values)
        return cls(values, mean, _blur(values * values) - mean**2)


class _Comparison(torch.autograd.Function):
    """Autograd's function behind ``compare``. It computes the gradient with the value, as both share the blurring."""

    @staticmethod
    def forward(
        ctx: Any, image: torch.Tensor, photo: PhotoMoments, l1_weight: float, ssim_weight: float
    ) -> torch.Tensor:
        if image.shape != photo.values.shape:
            raise ValueError(f"the picture is {tuple(image.shape)}, the photo {photo.values.shape}")
        count, values = image.numel(), image.detach().contiguous().numpy()
        gradient, sums = memory.empty(values.shape, np.float32), np.zeros((-(-len(values) // STRIP_ROWS), 2))
        weights = (l1_weight / count, ssim_weight / count)
        parallel_for(worker_count(), _compare_strips, values, photo, weights, gradient, sums)
        ctx.save_for_backward(torch.from_numpy(gradient))
        difference, similarity = sums.sum(axis=0) / count
        return image.new_tensor(l1_weight * difference + ssim_weight * similarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * gradients[0], None, None, None


def _compare_strips(
    worker: int,
    workers: int,
    image: NDArray[np.float32],
    photo: PhotoMoments,
    weights: tuple[float, float],
    gradient: NDArray[np.float32],
    sums: NDArray[np.float64],
) -> None:
    """Compare ``image`` with ``photo`` in every ``workers``-th strip of rows. Fills ``gradient`` [H, W, 3] and, by
    strip, ``sums`` [strips, 2] of |image - photo| and of SSIM. ``weights`` of L1 and of SSIM are those of one value."""
    for strip in range(worker, len(sums), workers):
        first, end = strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, len(image))
        # the gradient depends on SSIM's slopes within the window's reach, and these on pixels as far again
        near = slice(max(first - REACH, 0), min(end + REACH, len(image)))
        far = slice(max(first - 2 * REACH, 0), min(end + 2 * REACH, len(image)))
        x, y = image[far], photo.values[far]
        known = slice(near.start - far.start, near.stop - far.start)
        mean, square, product = (_blur(each)[known] for each in (x, x * x, x * y))
        ssim = np.empty_like(mean)
        given = (mean, square, product, photo.mean[near], photo.variance[near], ssim)
        _similarity(*(each.ravel() for each in given))
        own = slice(first - near.start, end - near.start)
        slopes = [_blur(slope)[own].ravel() for slope in (mean, square, product)]
        pair = image[first:end].ravel(), photo.values[first:end].ravel()
        sums[strip, 0] = _gradient(*pair, *slopes, np.array(weights, np.float32), gradient[first:end].ravel())
        sums[strip, 1] = ssim[own].sum(dtype=np.float64)


@contracted
def _similarity(
    mean: Array, square: Array, product: Array, photo_mean: Array, photo_variance: Array, ssim: Array
) -> None:
    """Compute ``ssim`` from blurred moments, all float32 [n]; replace ``mean``, ``square`` and ``product`` (of image
    and photo) by SSIM's derivatives by them."""
    for i in range(len(ssim)):
        x, y = mean[i], photo_mean[i]
        luminance, structure = TWO * x * y + C1, TWO * (product[i] - x * y) + C2
        first = ONE / (x * x + y * y + C1)
        second = ONE / (square[i] - x * x + photo_variance[i] + C2)
        scale = first * second
        ssim[i] = luminance * structure * scale
        mean[i] = TWO * (y * (structure - luminance) * scale + x * ssim[i] * (second - first))
        square[i] = -ssim[i] * second
        product[i] = TWO * luminance * scale


@contracted
def _gradient(
    image: Array, photo: Array, by_mean: Array, by_square: Array, by_product: Array, weights: Array, gradient: Array
) -> float:
    """Fill ``gradient`` from SSIM's blurred derivatives and from L1; return the sum of |image - photo|. Arrays are
    float32 [n]; ``weights`` [2] as in ``_compare_strips``."""
    total, l1, similarity = 0.0, weights[0], weights[1]
    for i in range(len(image)):
        off = image[i] - photo[i]
        slope = by_mean[i] + TWO * image[i] * by_square[i] + photo[i] * by_product[i]
        gradient[i] = l1 * np.sign(off) + similarity * slope
        total += abs(off)
    return total


def compare(
    image: torch.Tensor,  # [H, W, 3], 0 to 1
    photo: PhotoMoments,
    l1_weight: float,
    ssim_weight: float,
) -> torch.Tensor:
    """Return ``l1_weight`` * mean |image - photo| + ``ssim_weight`` * mean SSIM, a scalar, differentiable once in
    ``image``. Raises ValueError if the sizes differ."""
    result: torch.Tensor = _Comparison.apply(image, photo, l1_weight, ssim_weight)
    return result
