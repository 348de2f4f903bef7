"""SSIM and L1, and their gradient, against the formula in float64 with autograd."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.train.similarity import STRIP_ROWS, PhotoMoments, compare


def blur(planes: torch.Tensor) -> torch.Tensor:
    """[3, H, W] blurred by the 11x11 window of sigma 1.5 with zeros around."""
    offsets = torch.arange(11, dtype=torch.float64) - 5
    window = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = torch.outer(window, window) / window.sum() ** 2
    return torch.nn.functional.conv2d(planes[:, None], window[None, None], padding=5)[:, 0]


def plain(image: torch.Tensor, photo: torch.Tensor, l1_weight: float, ssim_weight: float) -> torch.Tensor:
    x, y = image.permute(2, 0, 1), photo.permute(2, 0, 1)
    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    ssim = (2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)
    ssim = ssim / ((mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4))
    return l1_weight * (x - y).abs().mean() + ssim_weight * ssim.mean()


def pictures(height: int, width: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth one with an edge, and a noisy copy; some of their values are equal."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    photo = 0.5 + 0.4 * np.sin(rows / 7 + seed)[..., None] * np.cos(columns / 5)[..., None] * [1.0, 0.7, -0.8]
    photo[:, width // 2 :] *= 0.3
    image = np.clip(photo + 0.1 * random.standard_normal(photo.shape), 0, 1)
    image[random.random(photo.shape) < 0.1] = 0.0
    image[: height // 3] = photo[: height // 3]
    return torch.from_numpy(image.astype(np.float32)), torch.from_numpy(photo.astype(np.float32))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 2 * STRIP_ROWS + 15), st.integers(1, 40), st.integers(0, 99))
def test_value_and_gradient_are_those_of_the_formula(height: int, width: int, seed: int) -> None:
    image, photo = pictures(height, width, seed)
    for weights in ((1.0, 0.0), (0.0, 1.0), (1.0, -0.2)):
        ours, exact = image.clone().requires_grad_(), image.double().requires_grad_()
        value, wanted = compare(ours, PhotoMoments.of(photo), *weights), plain(exact, photo.double(), *weights)
        np.testing.assert_allclose(value.item(), wanted.item(), atol=2e-6)
        (3 * value).backward()
        (3 * wanted).backward()
        size = exact.grad.square().mean().sqrt().item()
        torch.testing.assert_close(ours.grad.double(), exact.grad, rtol=1e-3, atol=2e-4 * size)


def test_pictures_may_have_any_memory_layout() -> None:
    image, photo = pictures(20, 31, 2)
    turned = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    moments = PhotoMoments.of(photo.permute(2, 0, 1).contiguous().permute(1, 2, 0))
    assert torch.equal(compare(turned, moments, 1.0, -0.2), compare(image, PhotoMoments.of(photo), 1.0, -0.2))


def test_the_number_of_threads_changes_no_bit() -> None:
    image, photo = pictures(3 * STRIP_ROWS + 7, 50, 4)
    moments, results, threads = PhotoMoments.of(photo), [], torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            leaf = image.clone().requires_grad_()
            value = compare(leaf, moments, 1.0, -0.2)
            value.backward()
            results.append((value.item(), leaf.grad.numpy().tobytes()))
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1] == results[2]
