"""Adam that survives growing, pruning and being stored."""

import numpy as np
import pytest
import torch

from engine.model.anchors import Anchors, initial_anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.train.optimiser import RATES, Optimiser, adam_step, learning_rate

SHAPE = DecoderShape(6, 2, 3, 4, distance_input=False, label_view_input=False)


def anchors_at(count: int) -> Anchors:
    positions = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    feature = np.zeros((count, 6), np.float32)
    return initial_anchors(positions, np.zeros(count, int), gaussians_per_anchor=2, feature=feature, voxel_size=0.1)


def take_steps(optimiser: Optimiser, steps: int, start: int = 0, rows: torch.Tensor | None = None) -> None:
    for step in range(start, start + steps):
        generator = torch.Generator().manual_seed(step)
        learnt = [getattr(optimiser.anchors, name) for name in Anchors.LEARNT]
        for parameter in (*learnt, *optimiser.decoders.parameters()):
            (parameter * torch.rand(parameter.shape, generator=generator)).sum().backward()
        optimiser.step(step / 100, torch.arange(len(optimiser.anchors)) if rows is None else rows)


def test_a_restored_optimiser_continues_bit_for_bit() -> None:
    whole = Optimiser(anchors_at(5), Decoders(SHAPE, 0), RATES, extent=2.0)
    take_steps(whole, 6)
    first = Optimiser(anchors_at(5), Decoders(SHAPE, 0), RATES, extent=2.0)
    take_steps(first, 3)
    again = Decoders(SHAPE, 9)
    again.load_state_dict(first.decoders.state_dict())
    second = Optimiser(first.anchors.select(torch.arange(5)), again, RATES, extent=2.0)
    second.restore({name: tensor.clone() for name, tensor in first.tensors().items()}, first.count)
    take_steps(second, 3, start=3)
    for name in Anchors.LEARNT:
        assert torch.equal(getattr(second.anchors, name), getattr(whole.anchors, name))
    for mine, theirs in zip(second.decoders.parameters(), whole.decoders.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_pruning_and_growing_keep_the_moments_of_kept_anchors() -> None:
    optimiser = Optimiser(anchors_at(5), Decoders(SHAPE, 0), RATES, extent=2.0)
    take_steps(optimiser, 2)
    before = {name: tensor.clone() for name, tensor in optimiser.tensors().items()}
    keep = torch.tensor([True, False, True, True, False])
    optimiser.replace_anchors(optimiser.anchors.select(keep).extended(anchors_at(2)), keep)
    after = optimiser.tensors()
    for name in ("anchors.feature.mean", "anchors.offset.square"):
        assert torch.equal(after[name][:3], before[name][keep])
        assert (after[name][3:] == 0).all()
    assert torch.equal(after["decoders.colour.0.weight.mean"], before["decoders.colour.0.weight.mean"])
    take_steps(optimiser, 1, start=2)


def test_only_anchors_that_are_seen_take_an_adam_step() -> None:
    seen = torch.tensor([4, 0, 3])
    optimiser = Optimiser(anchors_at(5), Decoders(SHAPE, 0), RATES, extent=2.0)
    take_steps(optimiser, 3)
    before = {name: tensor.clone() for name, tensor in optimiser.tensors().items()}
    start = {name: getattr(optimiser.anchors, name).detach().clone() for name in Anchors.LEARNT}
    expected = {}
    for name in Anchors.LEARNT:
        parameter, (mean, square) = start[name].double().requires_grad_(), optimiser.moments[f"anchors.{name}"]
        generator = torch.Generator().manual_seed(3)
        for each in Anchors.LEARNT[: Anchors.LEARNT.index(name) + 1]:
            factor = torch.rand(start[each].shape, generator=generator)
        parameter.grad = factor.double()
        rate = learning_rate(RATES[name], 0.03) * (2.0 if name == "offset" else 1.0)
        adam_step([parameter], [(mean.double(), square.double())], 3, rate, eps=1e-15, fused=False)
        expected[name] = parameter.detach().float()
    take_steps(optimiser, 1, start=3, rows=seen)
    for name in Anchors.LEARNT:
        now = getattr(optimiser.anchors, name).detach()
        torch.testing.assert_close(now[seen], expected[name][seen], rtol=1e-5, atol=1e-7)
        assert torch.equal(now[1:3], start[name][1:3]) and not torch.equal(now[seen], start[name][seen])
        for moment in ("mean", "square"):
            key = f"anchors.{name}.{moment}"
            assert torch.equal(optimiser.tensors()[key][1:3], before[key][1:3])


def test_learning_rates_decay_log_linearly() -> None:
    assert learning_rate((1e-2, 1e-4), 0.5) == pytest.approx(1e-3)
    assert learning_rate((1e-2, 1e-4), 0.0) == pytest.approx(1e-2)
