"""The kernels against the torch version in float64: values, and gradients of every input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import pytest
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


def decoded(case: Case, in_torch: bool = False) -> NeuralGaussians:
    asked = (case.anchors, case.decoders, case.visible, case.centre)
    if in_torch:
        return decode_in_torch(*asked, case.channels, None)
    return decode_rows(*asked, channels=case.channels)


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


def assert_matches(case: Case, only: tuple[str, ...] = OUTPUTS) -> None:
    double = asking(case.in_double())
    ours, theirs = decoded(asking(case)), decoded(double, in_torch=True)
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


@pytest.fixture(autouse=True)
def vector_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGS_DECODER_KERNELS", "vector")


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("visible", [1, 7, 64, 200])
@pytest.mark.parametrize("shape", SHAPES)
def test_matches_torch(shape: str, visible: int) -> None:
    assert_matches(case_of(SHAPES[shape], visible))


@pytest.mark.parametrize("only", [("cluster_loss",), ("labels",), ("opacities",), ("means", "scales")])
def test_each_output_has_its_own_gradient(only: tuple[str, ...]) -> None:
    assert_matches(case_of(STANDARD, 90), only)


@pytest.mark.parametrize("options", [(False, True), (True, False), (True, True)])
def test_both_options(options: tuple[bool, bool]) -> None:
    distance, labels = options
    assert_matches(case_of(replace(STANDARD, distance_input=distance, label_view_input=labels), 70))


def test_camera_inside_an_anchor_and_huge_features() -> None:
    """Saturated activations, and a direction that is none."""
    case = case_of(STANDARD, 40)
    case.anchors.position[case.visible[0]] = case.centre
    case.anchors.feature[case.visible[1:20]] *= 30.0
    assert_matches(case)


def silenced(case: Case) -> Case:
    """No Gaussian has an opacity above 0."""
    with torch.no_grad():
        case.decoders.opacity.get_parameter("2.weight").zero_()
        case.decoders.opacity.get_parameter("2.bias").fill_(-1.0)
    return case


def test_transparent_anchors_still_cluster() -> None:
    case = silenced(case_of(STANDARD, 70))
    assert_matches(case)
    gaussians = decoded(case)
    assert len(gaussians.kept) == 0 and gaussians.cluster_loss > 0


@pytest.mark.parametrize("unlabelled", ["none asked for", "none known"])
def test_without_classes_there_is_no_cluster_loss(unlabelled: str) -> None:
    case = case_of(STANDARD, 70)
    assert case.channels is not None
    case.channels = None if unlabelled == "none asked for" else torch.full_like(case.channels, -1)
    assert_matches(case)
    assert decoded(case).cluster_loss == 0


@pytest.mark.parametrize("anchors", [0, 5])
def test_nothing_visible(anchors: int) -> None:
    case = asking(case_of(STANDARD, 0, anchors=anchors))
    gaussians = decoded(case)
    assert gaussians.means.shape == (0, 3) and gaussians.labels.shape == (0, 43) and gaussians.kept.shape == (0,)
    assert gaussians.all_opacities.shape == (0, 4)
    assert not any(gradient.any() for gradient in gradients(case, gaussians).values())


def test_the_same_bits_with_any_number_of_threads(threads: None) -> None:
    case = asking(case_of(STANDARD, 3000))
    found = []
    for count in (1, 2, 3, 1):
        torch.set_num_threads(count)
        gaussians = decoded(case)
        found.append([*(getattr(gaussians, name) for name in OUTPUTS), *gradients(case, gaussians).values()])
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


def test_what_one_step_keeps_the_next_does_not_overwrite() -> None:
    """Outputs and gradients live in memory that is used again."""
    first, second = asking(case_of(STANDARD, 100)), asking(case_of(STANDARD, 100, seed=1))
    gaussians = decoded(first)
    kept = {name: getattr(gaussians, name).clone() for name in OUTPUTS}
    found = gradients(first, gaussians)
    copies = {name: gradient.clone() for name, gradient in found.items()}
    gradients(second, decoded(second))
    assert all(torch.equal(getattr(gaussians, name), kept[name]) for name in OUTPUTS)
    assert all(torch.equal(found[name], copies[name]) for name in found)


@pytest.mark.parametrize("in_torch", [False, True])
def test_known_labels_are_shown(in_torch: bool) -> None:
    case = case_of(STANDARD, 90)
    known = torch.rand(len(case.anchors) * 4, 20)
    asked = (case.anchors, case.decoders, case.visible, case.centre)
    shown = decode_in_torch(*asked, None, known) if in_torch else decode_rows(*asked, known_labels=known)
    anchor, gaussian = case.visible[shown.kept // 4], shown.kept % 4
    assert torch.equal(shown.labels, known[anchor * 4 + gaussian])
    assert torch.equal(shown.colours, decoded(case, in_torch).colours)


def test_with_known_labels_everything_else_is_trained() -> None:
    """A step without labels: the shapes and colours get their gradients, the label decoders get none."""
    drawn = ("means", "scales", "quats", "opacities", "colours")
    found = []
    for case in (asking(case_of(STANDARD, 90)), asking(case_of(STANDARD, 90).in_double())):
        known = torch.zeros(len(case.anchors) * 4, 1, dtype=case.anchors.feature.dtype)
        shown = decode_rows(case.anchors, case.decoders, case.visible, case.centre, known_labels=known)
        found.append(gradients(case, shown, drawn))
    for name, gradient in found[0].items():
        is_of_labels = name.startswith(("semantic", "instance"))
        assert gradient.any() != is_of_labels, name
        torch.testing.assert_close(gradient.double(), found[1][name], rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("output", ["colours", "labels", "scales"])
def test_nan_is_not_hidden(output: str) -> None:
    """A diverged decoder must reach the loss, which the trainer looks at."""
    case = case_of(STANDARD, 30)
    decoder = {"colours": "colour", "labels": "instance", "scales": "covariance"}[output]
    with torch.no_grad():
        getattr(case.decoders, decoder).get_parameter("2.bias").fill_(torch.nan)
    assert torch.isnan(getattr(decoded(case), output)).any()


@pytest.mark.parametrize("parameter", ["0.weight", "0.bias"])
@pytest.mark.parametrize("decoder", ["colour", "covariance", "semantic", "instance"])
def test_nan_comes_through_the_hidden_layer(decoder: str, parameter: str) -> None:
    case = case_of(STANDARD, 30)
    with torch.no_grad():
        getattr(case.decoders, decoder).get_parameter(parameter).fill_(torch.nan)
    out = decoded(case)
    reached = {"colour": out.colours, "covariance": out.scales, "semantic": out.labels, "instance": out.labels}
    assert torch.isnan(reached[decoder]).any()
