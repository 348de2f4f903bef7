"""Losses against plain formulas, and what their gradients must not reach."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.train.similarity import PhotoMoments, compare
from engine.train.trainer import reconstruction_loss


def test_ssim_matches_a_direct_computation() -> None:
    from scipy.ndimage import correlate1d

    rng = np.random.default_rng(0)
    a, b = rng.random((20, 24, 3)), rng.random((20, 24, 3))
    x = np.arange(11) - 5
    window = np.exp(-(x**2) / (2 * 1.5**2))
    window /= window.sum()

    def blur(image: np.ndarray) -> np.ndarray:
        image = correlate1d(image, window, axis=0, mode="constant")
        return correlate1d(image, window, axis=1, mode="constant")

    mean_a, mean_b = blur(a), blur(b)
    variance_a, variance_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    ssim = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    ssim /= (mean_a**2 + mean_b**2 + 1e-4) * (variance_a + variance_b + 9e-4)
    ours = compare(torch.from_numpy(a).float(), PhotoMoments.of(torch.from_numpy(b).float()), 0.0, 1.0)
    np.testing.assert_allclose(ours.item(), ssim.mean(), atol=1e-5)


def test_equal_images_cost_only_their_volume() -> None:
    image = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1))
    moments, scales = PhotoMoments.of(image), torch.full((5, 3), 0.1)
    loss = reconstruction_loss(image, moments, scales, photo_weight=1.0, ssim_weight=0.2, volume_weight=0.001)
    np.testing.assert_allclose(loss.item(), 0.001 * 5 * 1e-3, atol=1e-6)


def test_a_photo_that_counts_half_leaves_the_volume_as_it_is() -> None:
    random = torch.Generator().manual_seed(1)
    image, photo = (torch.rand(16, 16, 3, generator=random) for _ in range(2))
    scales = torch.full((5, 3), 0.5)

    def loss(photo_weight: float, volume_weight: float) -> float:
        weights = {"photo_weight": photo_weight, "ssim_weight": 0.2, "volume_weight": volume_weight}
        return reconstruction_loss(image, PhotoMoments.of(photo), scales, **weights).item()

    assert loss(0.5, 0.1) == pytest.approx(0.5 * loss(1.0, 0.0) + loss(0.0, 0.1), rel=1e-5)
    assert loss(0.0, 0.1) == pytest.approx(0.1 * 5 * 0.5**3)
