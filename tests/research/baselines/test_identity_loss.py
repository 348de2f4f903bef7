"""The losses of an identity encoding: their values in plain numpy, their gradients against float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from research.baselines.encodings import EncodedDecoders, EncodedShape
from research.baselines.identity_loss import identity_loss, neighbour_loss

SHAPE = EncodedShape(8, 2, 3, 5, distance_input=False, label_view_input=False, encoding=4)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("research.baselines.identity_loss.NEIGHBOURS", 3)
    monkeypatch.setattr("research.baselines.identity_loss.SAMPLES", 6)


def decoders_in(dtype: torch.dtype) -> EncodedDecoders:
    decoders = EncodedDecoders(SHAPE, 1)
    with torch.no_grad():
        decoders.classifier.weight.mul_(3.0)
    return decoders.to(dtype)


def picture(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(0)
    blended = torch.from_numpy(random.normal(size=(4, 5, 4))).to(dtype)
    alpha = torch.from_numpy(random.uniform(0.3, 1.0, (4, 5))).to(dtype)
    slot = torch.from_numpy(random.integers(-1, 5, (4, 5)).astype(np.int16))
    return blended.requires_grad_(), alpha.requires_grad_(), slot


def parameters_and(decoders: EncodedDecoders, tensor: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return tensor, *decoders.classifier.parameters()


def test_cross_entropy_of_the_pixels_that_are_known() -> None:
    decoders, (blended, alpha, slot) = decoders_in(torch.float64), picture(torch.float64)
    weight, bias = (each.detach().numpy() for each in decoders.classifier.parameters())
    costs = []
    for row, column in np.argwhere(slot.numpy() >= 0):
        logits = weight @ (blended.detach().numpy()[row, column] / alpha.detach().numpy()[row, column]) + bias
        costs.append(np.log(np.exp(logits).sum()) - logits[slot[row, column]])
    loss = identity_loss(blended, alpha, slot, decoders)
    assert loss.item() == pytest.approx(np.mean(costs) / np.log(5), rel=1e-6)
    loss.backward()
    assert alpha.grad is None and blended.grad is not None
    assert not blended.grad[slot < 0].any() and (blended.grad[slot >= 0].abs().amax(dim=1) > 0).all()
    assert identity_loss(blended, alpha, torch.full_like(slot, -1), decoders).item() == 0


def test_gradient_of_the_cross_entropy() -> None:
    decoders, (blended, alpha, slot) = decoders_in(torch.float64), picture(torch.float64)
    inputs = parameters_and(decoders, blended)
    assert torch.autograd.gradcheck(lambda *_: identity_loss(blended, alpha, slot, decoders), inputs)
    exact = torch.autograd.grad(identity_loss(blended, alpha, slot, decoders), inputs)
    single, (blended, alpha, slot) = decoders_in(torch.float32), picture(torch.float32)
    found = torch.autograd.grad(identity_loss(blended, alpha, slot, single), parameters_and(single, blended))
    for one, other in zip(found, exact, strict=True):
        torch.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-6)


def some_gaussians(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(1)
    means, encodings = random.normal(size=(12, 3)), random.normal(size=(12, 4))
    return torch.from_numpy(means).to(dtype), torch.from_numpy(encodings).to(dtype).requires_grad_()


def test_divergence_of_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    decoders, (means, encodings) = decoders_in(torch.float64), some_gaussians(torch.float64)
    monkeypatch.setattr("research.baselines.identity_loss.SAMPLES", 12)
    loss = neighbour_loss(means, encodings, decoders, np.random.default_rng(0))
    said = torch.softmax(decoders.classifier(encodings), dim=1).detach().numpy()
    points, costs = means.numpy(), []
    for number, point in enumerate(points):
        for near in np.argsort(np.linalg.norm(points - point, axis=1))[:3]:  # itself among them
            costs.append((said[number] * np.log(said[number] / said[near])).sum())
    assert loss.item() == pytest.approx(np.mean(costs) / 5, rel=1e-6)


def test_gradient_of_the_divergence() -> None:
    decoders, (means, encodings) = decoders_in(torch.float64), some_gaussians(torch.float64)
    inputs = parameters_and(decoders, encodings)

    def loss(*_: torch.Tensor) -> torch.Tensor:
        return neighbour_loss(means, encodings, decoders, np.random.default_rng(0))

    assert torch.autograd.gradcheck(loss, inputs)


def test_what_lies_apart_may_differ() -> None:
    """Two heaps of Gaussians, each of one encoding."""
    random = np.random.default_rng(2)
    means = torch.from_numpy(random.normal(size=(20, 3)) + np.repeat([[0.0], [100.0]], 10, axis=0))
    encodings = torch.from_numpy(np.repeat(random.normal(size=(2, 4)), 10, axis=0))
    decoders = decoders_in(torch.float64)
    assert neighbour_loss(means, encodings, decoders, random).item() == pytest.approx(0, abs=1e-12)
    mixed = encodings[torch.from_numpy(random.permutation(20))]
    assert neighbour_loss(means, mixed, decoders, random).item() > 0.01
    one = neighbour_loss(means[:1], encodings[:1], decoders, random)
    assert one.item() == 0 and neighbour_loss(means[:0], encodings[:0], decoders, random).item() == 0
