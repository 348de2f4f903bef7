"""The losses of picture, size and depth, against plain formulas."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.train.similarity import PhotoMoments
from engine.train.trainer import NEAR, NOISY, depth_loss, reconstruction_loss


def test_a_photo_that_counts_half_leaves_the_volume_as_it_is() -> None:
    random = torch.Generator().manual_seed(1)
    image, photo = (torch.rand(16, 16, 3, generator=random) for _ in range(2))
    scales = torch.full((5, 3), 0.5)

    def loss(photo_weight: float, volume_weight: float) -> float:
        weights = {"photo_weight": photo_weight, "ssim_weight": 0.2, "volume_weight": volume_weight}
        return reconstruction_loss(image, PhotoMoments.of(photo), scales, **weights).item()

    assert loss(0.5, 0.1) == pytest.approx(0.5 * loss(1.0, 0.0) + loss(0.0, 0.1), rel=1e-5)
    assert loss(0.0, 0.1) == pytest.approx(0.1 * 5 * 0.5**3)


def plainly(depth: np.ndarray, alpha: np.ndarray, sensor: np.ndarray) -> float:
    total = weights = 0.0
    for drawn, covered, measured in zip(depth.flat, alpha.flat, sensor.flat, strict=True):
        if measured > 0:
            gap = abs(drawn - covered * measured) + 0.5 * (1 - covered) * measured
            weight = 1 / (1 + (measured / NOISY) ** 2)
            total += weight * min(1.0, gap / max(measured, NEAR))
            weights += weight
    return total / weights if weights else 0.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_depth_loss_matches_the_formula(seed: int) -> None:
    random = np.random.default_rng(seed)
    alpha = random.uniform(0, 1, (5, 7))
    sensor = random.uniform(0.1, 8, (5, 7)) * (random.random((5, 7)) < random.choice([0.0, 0.5, 1.0]))
    depth = alpha * random.uniform(0.1, 8, (5, 7))
    loss = depth_loss(*(torch.from_numpy(each.astype(np.float32)) for each in (depth, alpha, sensor)))
    assert loss.item() == pytest.approx(plainly(depth, alpha, sensor), rel=1e-4, abs=1e-6)


def gradient(drawn: float, measured: float) -> float:
    depth = torch.tensor([[drawn, 2.0]], requires_grad=True)
    depth_loss(depth, torch.ones(1, 2), torch.tensor([[measured, 2.0]])).backward()
    assert depth.grad is not None
    return float(depth.grad[0, 0])


def test_depth_loss_pulls_towards_the_sensors_depth() -> None:
    assert gradient(1.9, 2.0) < 0 < gradient(2.1, 2.0)
    assert gradient(1.9, 0.0) == 0, "a pixel without depth says nothing"
    assert gradient(5.0, 2.0) == 0, "what is wrong by more than its depth is an outlier"
    assert abs(gradient(1.9 + NOISY, 2.0 + NOISY)) < abs(gradient(1.9, 2.0)), "far depth is noisy"


def test_a_view_without_depth_costs_nothing_and_can_be_trained_on() -> None:
    depth = torch.rand(3, 4, requires_grad=True)
    loss = depth_loss(depth, torch.rand(3, 4), torch.zeros(3, 4))
    loss.backward()
    assert loss.item() == 0 and depth.grad is not None and not depth.grad.any()
