"""Label losses against plain formulas, what their gradients must not reach, and the slots that steps assign."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.train.label_losses import TINY, ThingSegments, assigned_slots, label_losses
from tests.instances.assign_slots import assign_slots

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


def plain(coverage: torch.Tensor, alpha: torch.Tensor, first: int, *targets: torch.Tensor) -> torch.Tensor:
    """-log of the target's probability, added over targets, mean over pixels that have any."""
    total, known = coverage.new_zeros(()), torch.zeros(alpha.shape, dtype=torch.bool)
    for target in targets:
        rows, columns = (target >= 0).nonzero(as_tuple=True)
        chosen = coverage[rows, columns, first + target[rows, columns].long()]
        total = total - torch.log(chosen / (alpha[rows, columns] + TINY) + TINY).sum()
        known |= target >= 0
    return total / max(int(known.sum()), 1)


@pytest.mark.parametrize("upstream", [(1.0, 1.0), (0.2, -3.5)])
def test_losses_and_gradients_are_those_of_the_formula(upstream: tuple[float, float]) -> None:
    height, width, classes, slots = 97, 131, 5, 7  # more than one band
    coverage, alpha = picture(height, width, classes + slots)
    semantic, assigned, matched = random_targets(height, width, classes, slots)
    coverage[40, 50] = 0.0
    ours, exact = coverage.clone().requires_grad_(), coverage.double().requires_grad_()
    losses = label_losses(ours, alpha, classes, semantic, (assigned, matched))
    wanted = (
        plain(exact, alpha.double(), 0, semantic),
        plain(exact, alpha.double(), classes, assigned, matched),
    )
    for one, two, scale in zip(losses, wanted, upstream, strict=True):
        np.testing.assert_allclose(one.item(), two.item(), rtol=1e-6)
        (scale * one).backward(retain_graph=True)
        (scale * two).backward(retain_graph=True)
    torch.testing.assert_close(ours.grad.double(), exact.grad, rtol=1e-5, atol=0.0)


def test_unlabelled_pixels_do_not_count_and_alpha_is_never_reached() -> None:
    coverage = torch.full((2, 2, 3), 0.2, requires_grad=True)
    alpha = torch.full((2, 2), 0.8, requires_grad=True)
    target, none = torch.tensor([[0, -1], [2, -1]]), torch.full((2, 2), -1)
    semantic, instance = label_losses(coverage, alpha, 3, target, (none, none))
    np.testing.assert_allclose(semantic.item(), -np.log(0.25), rtol=1e-5)
    (semantic + instance).backward()
    assert alpha.grad is None
    assert (coverage.grad[:, 1] == 0).all() and (coverage.grad[:, 0] != 0).any()


def test_without_any_target_losses_are_zero_with_a_gradient() -> None:
    coverage, none = torch.rand(2, 2, 3, requires_grad=True), torch.full((2, 2), -1)
    semantic, instance = label_losses(coverage, torch.ones(2, 2), 1, none, (none, none))
    (semantic + instance).backward()
    assert semantic.item() == 0 and instance.item() == 0 and (coverage.grad == 0).all()


def test_improbable_targets_have_the_right_loss() -> None:
    """Their product leaves float64 unless logarithms are taken on the way."""
    zeros, none = torch.zeros(40, 40, 2), torch.full((40, 40), -1)
    target = torch.zeros(40, 40, dtype=torch.int16)
    semantic, instance = label_losses(zeros, torch.ones(40, 40), 1, target, (target, none))
    np.testing.assert_allclose([semantic.item(), instance.item()], -np.log(1e-8), rtol=1e-6)


def test_nan_stays_nan() -> None:
    coverage, target = torch.full((4, 4, 2), 0.5), torch.zeros(4, 4, dtype=torch.int16)
    coverage[1, 1] = float("nan")
    assert all(loss.isnan() for loss in label_losses(coverage, torch.ones(4, 4), 1, target, (target, target)))


def test_the_number_of_threads_changes_no_bit() -> None:
    coverage, alpha = picture(150, 170, 12)
    semantic, *instance = random_targets(150, 170, 5, 7)
    results = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            leaf = coverage.clone().requires_grad_()
            losses = label_losses(leaf, alpha, 5, semantic, tuple(instance))
            (losses[0] + 0.3 * losses[1]).backward()
            results.append((losses[0].item(), losses[1].item(), leaf.grad.numpy().tobytes()))
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1] == results[2]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 6), st.integers(0, 5), st.integers(0, 3))
def test_assigned_slots_match_plain_assignment(seed: int, slots: int, instances: int, first: int) -> None:
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
