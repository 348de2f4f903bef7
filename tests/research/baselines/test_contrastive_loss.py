"""The contrastive loss: its value in plain numpy, its gradient against float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.train.assignment import ThingSegments
from research.baselines.contrastive_loss import concentration, contrast, contrastive_loss

IDS = np.array([[0, 4, 4, 4, 0], [9, 9, 4, 4, 4], [9, 9, 9, 4, 4], [0, 9, 9, 0, 0]])


def picture(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(0)
    blended = torch.from_numpy(random.normal(size=(*IDS.shape, 6))).to(dtype)
    alpha = torch.from_numpy(random.uniform(0.3, 1.0, IDS.shape)).to(dtype)
    return blended.requires_grad_(), alpha.requires_grad_()


def loss_of(blended: torch.Tensor, alpha: torch.Tensor, ids: np.ndarray = IDS) -> torch.Tensor:
    return contrastive_loss(blended, alpha, ThingSegments.of(ids), np.random.default_rng(3))


def test_both_parts_in_plain_numpy() -> None:
    random = np.random.default_rng(1)
    fast, slow = random.normal(size=(7, 3)), random.normal(size=(6, 3))
    segment, other = np.array([0, 0, 1, 1, 1, 2, 0]), np.array([0, 1, 1, 0, 3, 1])  # 2 has no slow embedding
    near: dict[int, list[float]] = {0: [], 1: []}
    shares = []
    for one, embedded in zip(segment, fast, strict=True):
        if one == 2:
            continue
        centre = slow[other == one].mean(axis=0)
        near[one].append(np.exp(-((embedded - centre) ** 2).sum()))
        like = np.exp(np.exp(-np.linalg.norm(slow - embedded, axis=1)))
        shares.append(like[other == one].sum() / like.sum())
    tensors = torch.from_numpy(fast), torch.from_numpy(slow)
    is_one = torch.from_numpy(segment[:, None] == other)
    found = concentration(*tensors, torch.from_numpy(segment), is_one)
    assert found.item() == pytest.approx(-np.mean([np.mean(each) for each in near.values()]))
    assert contrast(*tensors, is_one).item() == pytest.approx(-np.log(shares).mean())


def test_the_gradient_matches_differences() -> None:
    blended, alpha = picture(torch.float64)
    (exact,) = torch.autograd.grad(loss_of(blended, alpha), blended)
    fast = blended.detach()[..., :3].clone().requires_grad_()
    slow = blended.detach()[..., 3:]
    assert torch.autograd.gradcheck(lambda each: loss_of(torch.cat([each, slow], dim=2), alpha), fast)
    single, opaque = picture(torch.float32)
    (found,) = torch.autograd.grad(loss_of(single, opaque), single)
    torch.testing.assert_close(found.double(), exact, rtol=1e-3, atol=1e-6)


def test_what_gradients_reach() -> None:
    blended, alpha = picture(torch.float64)
    loss_of(blended, alpha).backward()
    assert alpha.grad is None and blended.grad is not None
    assert not blended.grad[..., 3:].any(), "the slow embeddings follow, they are not pulled"
    assert not blended.grad[torch.from_numpy(IDS == 0)].any() and blended.grad[..., :3].any()


def test_less_if_segments_are_told_apart() -> None:
    told = torch.from_numpy(np.repeat(IDS[..., None], 6, axis=2).astype(np.float64))
    alpha = torch.ones(IDS.shape, dtype=torch.float64)
    assert loss_of(told, alpha) < loss_of(torch.zeros_like(told), alpha) - 0.1


@pytest.mark.parametrize("ids", [np.zeros_like(IDS), np.where(np.arange(20).reshape(4, 5) == 7, 3, 0)])
def test_nothing_to_compare(ids: np.ndarray) -> None:
    blended, alpha = picture(torch.float64)
    loss = loss_of(blended, alpha, ids)
    loss.backward()
    assert loss.item() == 0 and blended.grad is not None and not blended.grad.any()


def test_two_pixels_of_two_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pixel has another of its segment among the slow ones."""
    ids = np.zeros_like(IDS)
    ids[0, 0], ids[1, 1] = 1, 2
    blended, alpha = picture(torch.float64)
    assert loss_of(blended, alpha, ids).item() == 0
    monkeypatch.setattr("research.baselines.contrastive_loss.PIXELS", 2)
    assert loss_of(blended, alpha).isfinite()
