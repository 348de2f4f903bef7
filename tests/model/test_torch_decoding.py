"""Decoding in torch and by the kernels, in float32 against float64, and what the trainer relies on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch

from engine.model.anchors import Anchors, AnchorsInView
from engine.model.decoders import Decoders, DecoderShape
from engine.model.gaussians import decode_rows
from engine.model.neural_gaussians import NeuralGaussians
from engine.model.torch_decoding import cluster_loss, decode_in_torch

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

    def given(self, known: torch.Tensor | None) -> AnchorsInView:
        return AnchorsInView(
            self.anchors, self.visible, self.centre, None if known is not None else self.channels, known
        )

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
    return decode_in_torch(case.given(known), case.decoders)


def by_kernels(case: Case, known: torch.Tensor | None = None) -> NeuralGaussians:
    """In float32. For float64, ``decode_rows`` takes torch."""
    return decode_rows(case.given(known), case.decoders)


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


@pytest.fixture(params=[by_torch, by_kernels])
def decode(request: pytest.FixtureRequest) -> Decode:
    """Both ways."""
    way: Decode = request.param
    return way


@pytest.mark.parametrize("visible", [1, 7, 64, 200])
@pytest.mark.parametrize("shape", SHAPES)
def test_decoding_in_float32_agrees_with_float64(decode: Decode, shape: str, visible: int) -> None:
    assert_matches(decode, case_of(SHAPES[shape], visible))


@pytest.mark.parametrize("only", [("cluster_loss",), ("labels",), ("opacities",), ("means", "scales")])
def test_each_output_of_the_decoders_has_its_own_gradient(decode: Decode, only: tuple[str, ...]) -> None:
    assert_matches(decode, case_of(STANDARD, 90), only)


def test_a_camera_inside_an_anchor_and_huge_features_are_decoded(decode: Decode) -> None:
    """Activations saturate, and the direction has no length."""
    case = case_of(STANDARD, 40)
    case.anchors.position[case.visible[0]] = case.centre
    case.anchors.feature[case.visible[1:20]] *= 30.0
    assert_matches(decode, case)


def test_labels_given_to_the_decoder_replace_decoded_ones(decode: Decode) -> None:
    case = case_of(STANDARD, 90)
    known = torch.rand(len(case.anchors) * 4, 20)
    shown = decode(case, known)
    anchor, gaussian = case.visible[shown.kept // 4], shown.kept % 4
    assert torch.equal(shown.labels, known[anchor * 4 + gaussian])
    assert torch.equal(shown.colours, decode(case).colours)


def test_transparent_anchors_still_count_in_the_cluster_loss(decode: Decode) -> None:
    case = case_of(STANDARD, 70)
    with torch.no_grad():
        case.decoders.opacity.get_parameter("2.weight").zero_()
        case.decoders.opacity.get_parameter("2.bias").fill_(-1.0)
    assert_matches(decode, case)
    gaussians = decode(case)
    assert len(gaussians.kept) == 0 and gaussians.cluster_loss > 0


@pytest.mark.parametrize("unlabelled", ["none asked for", "none known"])
def test_without_classes_there_is_no_cluster_loss(decode: Decode, unlabelled: str) -> None:
    case = case_of(STANDARD, 70)
    assert case.channels is not None
    case.channels = None if unlabelled == "none asked for" else torch.full_like(case.channels, -1)
    assert_matches(decode, case)
    assert decode(case).cluster_loss == 0


@pytest.mark.parametrize("anchors", [0, 5])
def test_without_visible_anchors_no_gaussian_is_decoded(decode: Decode, anchors: int) -> None:
    case = asking(case_of(STANDARD, 0, anchors=anchors))
    gaussians = decode(case)
    assert gaussians.means.shape == (0, 3) and gaussians.labels.shape == (0, 43) and gaussians.kept.shape == (0,)
    assert gaussians.all_opacities.shape == (0, 4)
    assert not any(gradient.any() for gradient in gradients(case, gaussians).values())


def test_given_labels_do_not_stop_the_training_of_other_outputs(decode: Decode) -> None:
    """A step without labels: the shapes and colours get their gradients, the label decoders get none."""
    drawn = ("means", "scales", "quats", "opacities", "colours")
    found = []
    for case in (asking(case_of(STANDARD, 90)), asking(case_of(STANDARD, 90).in_double())):
        known = torch.zeros(len(case.anchors) * 4, 1, dtype=case.anchors.feature.dtype)
        shown = decode(case, known)
        found.append(gradients(case, shown, drawn))
    for name, gradient in found[0].items():
        is_of_labels = name.startswith(("semantic", "instance"))
        assert gradient.any() != is_of_labels, name
        torch.testing.assert_close(gradient.double(), found[1][name], rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("parameter", ["0.weight", "0.bias", "2.bias"])
@pytest.mark.parametrize("decoder", ["colour", "covariance", "semantic", "instance"])
def test_nan_in_a_decoder_is_not_hidden_in_its_output(decode: Decode, decoder: str, parameter: str) -> None:
    """The trainer looks at the loss, so a diverged decoder must reach it."""
    case = case_of(STANDARD, 30)
    with torch.no_grad():
        getattr(case.decoders, decoder).get_parameter(parameter).fill_(torch.nan)
    out = decode(case)
    reached = {"colour": out.colours, "covariance": out.scales, "semantic": out.labels, "instance": out.labels}
    assert torch.isnan(reached[decoder]).any()


def test_the_cluster_loss_counts_only_gaussians_of_labelled_anchors() -> None:
    logits = torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(2))
    target = torch.tensor([0, -1, 2, -1])
    log = torch.log_softmax(logits, dim=2)
    expected = -(log[0, :, 0].sum() + log[2, :, 2].sum()) / 4
    torch.testing.assert_close(cluster_loss(logits, target), expected)


def test_decoding_gives_the_same_bits_with_any_number_of_threads() -> None:
    case, found, threads = asking(case_of(STANDARD, 3000)), [], torch.get_num_threads()
    try:
        for count in (1, 2, 3, 1):
            torch.set_num_threads(count)
            gaussians = by_kernels(case)
            found.append([*(getattr(gaussians, name) for name in OUTPUTS), *gradients(case, gaussians).values()])
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


def test_a_training_step_does_not_overwrite_tensors_of_the_step_before() -> None:
    """Outputs and gradients live in memory that is used again."""
    first, second = asking(case_of(STANDARD, 100)), asking(case_of(STANDARD, 100, seed=1))
    gaussians = by_kernels(first)
    kept = {name: getattr(gaussians, name).clone() for name in OUTPUTS}
    found = gradients(first, gaussians)
    copies = {name: gradient.clone() for name, gradient in found.items()}
    gradients(second, by_kernels(second))
    assert all(torch.equal(getattr(gaussians, name), kept[name]) for name in OUTPUTS)
    assert all(torch.equal(found[name], copies[name]) for name in found)
