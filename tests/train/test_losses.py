"""The losses of picture, size, depth and labels, and their gradients, against plain formulas."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from engine.train.label_losses import TINY, ThingSegments, assigned_slots, label_losses
from engine.train.similarity import STRIP_ROWS, PhotoMoments, compare
from engine.train.trainer import NEAR, NOISY, depth_loss, reconstruction_loss


def assign_slots(probabilities: NDArray[np.floating], instance_ids: NDArray[np.integer]) -> NDArray[np.int32]:
    """The slot that the Hungarian algorithm gives each pixel's instance by mean probability; -1: none is left."""
    target = np.full(instance_ids.shape, -1, np.int32)
    inside = instance_ids != 0
    ids, row = np.unique(instance_ids[inside], return_inverse=True)
    if not len(ids) or not probabilities.shape[-1]:
        return target
    row = row.reshape(-1)
    shown = probabilities[inside].astype(np.float64)
    count = np.bincount(row, minlength=len(ids))
    mean = np.column_stack([np.bincount(row, column, len(ids)) / count for column in shown.T])
    slot_of_row = np.full(len(mean), -1, np.int32)
    rows, slots = linear_sum_assignment(-mean)
    slot_of_row[rows] = slots
    target[inside] = slot_of_row[row]
    return target


def test_the_weight_of_a_photo_does_not_change_the_volume_loss() -> None:
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
def test_the_depth_loss_matches_its_formula(seed: int) -> None:
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


def test_the_depth_loss_pulls_towards_the_sensors_depth() -> None:
    assert gradient(1.9, 2.0) < 0 < gradient(2.1, 2.0)
    assert gradient(1.9, 0.0) == 0, "a pixel without depth says nothing"
    assert gradient(5.0, 2.0) == 0, "what is wrong by more than its depth is an outlier"
    assert abs(gradient(1.9 + NOISY, 2.0 + NOISY)) < abs(gradient(1.9, 2.0)), "far depth is noisy"


def test_a_view_without_depth_has_no_depth_loss() -> None:
    depth = torch.rand(3, 4, requires_grad=True)
    loss = depth_loss(depth, torch.rand(3, 4), torch.zeros(3, 4))
    loss.backward()
    assert loss.item() == 0 and depth.grad is not None and not depth.grad.any()


def blur(planes: torch.Tensor) -> torch.Tensor:
    """[3, H, W] blurred by the 11x11 window of sigma 1.5 with zeros around."""
    offsets = torch.arange(11, dtype=torch.float64) - 5
    window = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = torch.outer(window, window) / window.sum() ** 2
    return torch.nn.functional.conv2d(planes[:, None], window[None, None], padding=5)[:, 0]


def plain_similarity(image: torch.Tensor, photo: torch.Tensor, l1_weight: float, ssim_weight: float) -> torch.Tensor:
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
def test_the_picture_loss_and_its_gradient_match_the_formula(height: int, width: int, seed: int) -> None:
    image, photo = pictures(height, width, seed)
    for weights in ((1.0, 0.0), (0.0, 1.0), (1.0, -0.2)):
        ours, exact = image.clone().requires_grad_(), image.double().requires_grad_()
        value, wanted = (
            compare(ours, PhotoMoments.of(photo), *weights),
            plain_similarity(exact, photo.double(), *weights),
        )
        np.testing.assert_allclose(value.item(), wanted.item(), atol=2e-6)
        (3 * value).backward()
        (3 * wanted).backward()
        size = exact.grad.square().mean().sqrt().item()
        torch.testing.assert_close(ours.grad.double(), exact.grad, rtol=1e-3, atol=2e-4 * size)


def test_losses_accept_pictures_of_any_memory_layout() -> None:
    image, photo = pictures(20, 31, 2)
    turned = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    moments = PhotoMoments.of(photo.permute(2, 0, 1).contiguous().permute(1, 2, 0))
    assert torch.equal(compare(turned, moments, 1.0, -0.2), compare(image, PhotoMoments.of(photo), 1.0, -0.2))


Targets = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def picture(height: int, width: int, channels: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    coverage = torch.rand(height, width, channels, generator=generator) * 0.3
    return coverage, 0.2 + 0.8 * torch.rand(height, width, generator=generator)


def random_targets(height: int, width: int, classes: int, slots: int) -> Targets:
    random = np.random.default_rng(3)
    semantic, assigned, matched = (random.integers(-1, most, (height, width)) for most in (classes, slots, slots))
    assigned[:2], matched[:, :3] = -1, -1
    matched[-1] = assigned[-1]  # both name the same slot
    return tuple(torch.from_numpy(each).to(torch.int16) for each in (semantic, assigned, matched))  # type: ignore[return-value]


def plain_label_loss(coverage: torch.Tensor, alpha: torch.Tensor, first: int, *targets: torch.Tensor) -> torch.Tensor:
    """-log of the target's probability, added over targets, mean over pixels that have any."""
    total, known = coverage.new_zeros(()), torch.zeros(alpha.shape, dtype=torch.bool)
    for target in targets:
        rows, columns = (target >= 0).nonzero(as_tuple=True)
        chosen = coverage[rows, columns, first + target[rows, columns].long()]
        total = total - torch.log(chosen / (alpha[rows, columns] + TINY) + TINY).sum()
        known |= target >= 0
    return total / max(int(known.sum()), 1)


@pytest.mark.parametrize("upstream", [(1.0, 1.0), (0.2, -3.5)])
def test_label_losses_and_gradients_match_their_formulas(upstream: tuple[float, float]) -> None:
    height, width, classes, slots = 97, 131, 5, 7  # more than one band
    coverage, alpha = picture(height, width, classes + slots)
    semantic, assigned, matched = random_targets(height, width, classes, slots)
    coverage[40, 50] = 0.0
    ours, exact = coverage.clone().requires_grad_(), coverage.double().requires_grad_()
    losses = label_losses(ours, alpha, classes, semantic, (assigned, matched))
    wanted = (
        plain_label_loss(exact, alpha.double(), 0, semantic),
        plain_label_loss(exact, alpha.double(), classes, assigned, matched),
    )
    for one, two, scale in zip(losses, wanted, upstream, strict=True):
        np.testing.assert_allclose(one.item(), two.item(), rtol=1e-6)
        (scale * one).backward(retain_graph=True)
        (scale * two).backward(retain_graph=True)
    torch.testing.assert_close(ours.grad.double(), exact.grad, rtol=1e-5, atol=0.0)


def test_label_losses_ignore_unlabelled_pixels() -> None:
    coverage = torch.full((2, 2, 3), 0.2, requires_grad=True)
    alpha = torch.full((2, 2), 0.8, requires_grad=True)
    target, none = torch.tensor([[0, -1], [2, -1]]), torch.full((2, 2), -1)
    semantic, instance = label_losses(coverage, alpha, 3, target, (none, none))
    np.testing.assert_allclose(semantic.item(), -np.log(0.25), rtol=1e-5)
    (semantic + instance).backward()
    assert alpha.grad is None
    assert (coverage.grad[:, 1] == 0).all() and (coverage.grad[:, 0] != 0).any()


def test_label_losses_without_targets_are_zero() -> None:
    coverage, none = torch.rand(2, 2, 3, requires_grad=True), torch.full((2, 2), -1)
    semantic, instance = label_losses(coverage, torch.ones(2, 2), 1, none, (none, none))
    (semantic + instance).backward()
    assert semantic.item() == 0 and instance.item() == 0 and (coverage.grad == 0).all()


def test_the_label_loss_is_right_for_very_improbable_targets() -> None:
    """Their product leaves float64 unless logarithms are taken on the way."""
    zeros, none = torch.zeros(40, 40, 2), torch.full((40, 40), -1)
    target = torch.zeros(40, 40, dtype=torch.int16)
    semantic, instance = label_losses(zeros, torch.ones(40, 40), 1, target, (target, none))
    np.testing.assert_allclose([semantic.item(), instance.item()], -np.log(1e-8), rtol=1e-6)


def test_a_nan_input_gives_a_nan_loss() -> None:
    coverage, target = torch.full((4, 4, 2), 0.5), torch.zeros(4, 4, dtype=torch.int16)
    coverage[1, 1] = float("nan")
    assert all(loss.isnan() for loss in label_losses(coverage, torch.ones(4, 4), 1, target, (target, target)))


def test_losses_have_the_same_bits_with_any_number_of_threads() -> None:
    image, photo = pictures(3 * STRIP_ROWS + 7, 50, 4)
    coverage, alpha = picture(150, 170, 12)
    semantic, *instance = random_targets(150, 170, 5, 7)
    moments, results, threads = PhotoMoments.of(photo), [], torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            drawn, shares = (each.clone().requires_grad_() for each in (image, coverage))
            losses = compare(drawn, moments, 1.0, -0.2), *label_losses(shares, alpha, 5, semantic, tuple(instance))
            (losses[0] + losses[1] + 0.3 * losses[2]).backward()
            results.append(
                [*map(torch.Tensor.item, losses), *(each.grad.numpy().tobytes() for each in (drawn, shares))]
            )
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1] == results[2]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 6), st.integers(0, 5), st.integers(0, 3))
def test_slots_of_segments_match_a_plain_implementation(seed: int, slots: int, instances: int, first: int) -> None:
    random = np.random.default_rng(seed)
    coverage = random.random((90, 101, first + slots), dtype=np.float32)
    alpha = random.uniform(0.1, 1.0, (90, 101)).astype(np.float32)
    ids = random.integers(0, instances + 1, (90, 101)) * 1000
    if seed % 2:
        ids[ids == 0] = 7  # every pixel is of some instance
    got = assigned_slots(torch.from_numpy(coverage), torch.from_numpy(alpha), first, ThingSegments.of(ids))
    probability = coverage[..., first:].astype(np.float64) / (alpha[..., None].astype(np.float64) + 1e-8)
    assert got.dtype == torch.int16
    assert (got.numpy() == assign_slots(probability, ids)).all()
