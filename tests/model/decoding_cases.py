"""Anchors and decoders for the tests of decoding, and how two ways of it are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from engine.model.anchors import Anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.model.gaussians import decode_rows
from engine.model.neural_gaussians import NeuralGaussians
from engine.model.torch_decoding import decode_in_torch

OUTPUTS = ("means", "scales", "quats", "opacities", "colours", "labels", "cluster_loss")
STANDARD = DecoderShape(32, 4, 18, 25, distance_input=False, label_view_input=False)
PAPER = DecoderShape(32, 10, 7, 41, distance_input=True, label_view_input=True)
SMALL = DecoderShape(8, 3, 1, 1, distance_input=True, label_view_input=False)
WIDE = DecoderShape(20, 1, 16, 200, distance_input=False, label_view_input=True)
SHAPES = {"standard": STANDARD, "paper": PAPER, "small": SMALL, "wide": WIDE}


@dataclass
class Case:
    """Anchors, decoders and what is asked of them."""

    anchors: Anchors
    decoders: Decoders
    visible: torch.Tensor
    centre: torch.Tensor
    channels: torch.Tensor | None

    def inputs(self) -> dict[str, torch.Tensor]:
        learnt = {name: getattr(self.anchors, name) for name in Anchors.LEARNT}
        return {**learnt, **dict(self.decoders.named_parameters())}

    def in_double(self) -> Case:
        tensors = {name: tensor.clone() for name, tensor in self.anchors.tensors().items()}
        for name in (*Anchors.LEARNT, "position"):
            tensors[name] = tensors[name].double()
        decoders = Decoders(self.decoders.shape, 0).double()
        decoders.load_state_dict({name: each.double() for name, each in self.decoders.state_dict().items()})
        return Case(Anchors(**tensors), decoders, self.visible, self.centre.double(), self.channels)


def case_of(shape: DecoderShape, visible: int, *, anchors: int | None = None, seed: int = 0) -> Case:
    """Every third anchor has no class; opacities of both signs."""
    count = 2 * visible + 3 if anchors is None else anchors
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    channels = torch.randint(0, shape.classes, (count,), generator=generator)
    channels[::3] = -1
    made = Anchors(
        position=2 * normal(count, 3),
        feature=normal(count, shape.features),
        offset=normal(count, shape.gaussians_per_anchor, 3),
        log_scale=normal(count, 6) - 2,
        level=torch.zeros(count, dtype=torch.int64),
        initial_class=channels + 1,
    )
    rows = torch.randperm(count, generator=generator)[:visible].sort().values
    return Case(made, Decoders(shape, seed), rows, torch.tensor([0.3, -0.2, 0.1]), channels)


def by_torch(case: Case, known: torch.Tensor | None = None) -> NeuralGaussians:
    channels = case.channels if known is None else None
    return decode_in_torch(case.anchors, case.decoders, case.visible, case.centre, channels, known)


def by_kernels(case: Case, known: torch.Tensor | None = None) -> NeuralGaussians:
    """In float32. For float64, ``decode_rows`` takes torch."""
    channels = case.channels if known is None else None
    asked = case.anchors, case.decoders, case.visible, case.centre
    return decode_rows(*asked, channels=channels, known_labels=known)


Decode = Callable[..., NeuralGaussians]
"""Either of these."""


def gradients(case: Case, gaussians: NeuralGaussians, only: tuple[str, ...] = OUTPUTS) -> dict[str, torch.Tensor]:
    """Of a random weighting of the outputs, in all inputs."""
    total = torch.zeros((), dtype=gaussians.means.dtype)
    for number, name in enumerate(OUTPUTS):
        output = getattr(gaussians, name)
        weight = torch.randn(output.shape, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
        scale = 100.0 if name == "cluster_loss" else 1.0
        if name in only:
            total = total + scale * (output * weight.to(output.dtype)).sum()
    inputs = case.inputs()
    found = torch.autograd.grad(total, list(inputs.values()), allow_unused=True)
    return {
        name: torch.zeros_like(given) if gradient is None else gradient
        for (name, given), gradient in zip(inputs.items(), found, strict=True)
    }


def asking(case: Case) -> Case:
    for tensor in case.inputs().values():
        tensor.requires_grad_()
    return case


def assert_matches(decode: Decode, case: Case, only: tuple[str, ...] = OUTPUTS) -> None:
    """Float32 by ``decode`` has the values and gradients of float64 in torch."""
    double = asking(case.in_double())
    ours, theirs = decode(asking(case)), by_torch(double)
    assert torch.equal(ours.kept, theirs.kept)
    torch.testing.assert_close(ours.all_opacities.double(), theirs.all_opacities, rtol=1e-5, atol=1e-6)
    for name in OUTPUTS:
        got, expected = getattr(ours, name), getattr(theirs, name)
        torch.testing.assert_close(
            got.double(), expected, rtol=1e-4, atol=1e-6, msg=lambda text, name=name: f"{name}: {text}"
        )
    found, wanted = gradients(case, ours, only), gradients(double, theirs, only)
    for name, expected in wanted.items():
        typical = float(expected.square().mean().sqrt()) if expected.numel() else 0.0
        torch.testing.assert_close(
            found[name].double(),
            expected,
            rtol=1e-4,
            atol=1e-5 * typical + 1e-6,  # a lone class has no gradient at all
            msg=lambda text, name=name: f"gradient of {name}: {text}",
        )
