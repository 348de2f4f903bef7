"""Decoding in torch and by the kernels, in float32 against float64, and what the trainer relies on."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from engine.model.torch_decoding import cluster_loss
from tests.model.decoding_cases import (
    OUTPUTS,
    SHAPES,
    STANDARD,
    Case,
    Decode,
    asking,
    assert_matches,
    by_kernels,
    by_torch,
    case_of,
    gradients,
)


@pytest.fixture(params=[by_torch, by_kernels])
def decode(request: pytest.FixtureRequest) -> Decode:
    """Both ways."""
    way: Decode = request.param
    return way


@pytest.mark.parametrize("visible", [1, 7, 64, 200])
@pytest.mark.parametrize("shape", SHAPES)
def test_float32_agrees_with_float64(decode: Decode, shape: str, visible: int) -> None:
    assert_matches(decode, case_of(SHAPES[shape], visible))


@pytest.mark.parametrize("only", [("cluster_loss",), ("labels",), ("opacities",), ("means", "scales")])
def test_each_output_has_its_own_gradient(decode: Decode, only: tuple[str, ...]) -> None:
    assert_matches(decode, case_of(STANDARD, 90), only)


def test_a_camera_inside_an_anchor_and_huge_features_are_decode(decode: Decode) -> None:
    """Activations saturate, and the direction has no length."""
    case = case_of(STANDARD, 40)
    case.anchors.position[case.visible[0]] = case.centre
    case.anchors.feature[case.visible[1:20]] *= 30.0
    assert_matches(decode, case)


def test_known_labels_are_shown(decode: Decode) -> None:
    case = case_of(STANDARD, 90)
    known = torch.rand(len(case.anchors) * 4, 20)
    shown = decode(case, known)
    anchor, gaussian = case.visible[shown.kept // 4], shown.kept % 4
    assert torch.equal(shown.labels, known[anchor * 4 + gaussian])
    assert torch.equal(shown.colours, decode(case).colours)


def silenced(case: Case) -> Case:
    """No Gaussian has an opacity above 0."""
    with torch.no_grad():
        case.decoders.opacity.get_parameter("2.weight").zero_()
        case.decoders.opacity.get_parameter("2.bias").fill_(-1.0)
    return case


def test_transparent_anchors_still_cluster(decode: Decode) -> None:
    case = silenced(case_of(STANDARD, 70))
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
def test_nothing_visible_gives_no_gaussians(decode: Decode, anchors: int) -> None:
    case = asking(case_of(STANDARD, 0, anchors=anchors))
    gaussians = decode(case)
    assert gaussians.means.shape == (0, 3) and gaussians.labels.shape == (0, 43) and gaussians.kept.shape == (0,)
    assert gaussians.all_opacities.shape == (0, 4)
    assert not any(gradient.any() for gradient in gradients(case, gaussians).values())


def test_with_known_labels_everything_else_is_trained(decode: Decode) -> None:
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
def test_nan_in_a_decoder_reaches_its_output(decode: Decode, decoder: str, parameter: str) -> None:
    """The trainer looks at the loss, so a diverged decoder must reach it."""
    case = case_of(STANDARD, 30)
    with torch.no_grad():
        getattr(case.decoders, decoder).get_parameter(parameter).fill_(torch.nan)
    out = decode(case)
    reached = {"colour": out.colours, "covariance": out.scales, "semantic": out.labels, "instance": out.labels}
    assert torch.isnan(reached[decoder]).any()


def test_cluster_loss_counts_every_gaussian_of_labelled_anchors_only() -> None:
    logits = torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(2))
    target = torch.tensor([0, -1, 2, -1])
    log = torch.log_softmax(logits, dim=2)
    expected = -(log[0, :, 0].sum() + log[2, :, 2].sum()) / 4
    torch.testing.assert_close(cluster_loss(logits, target), expected)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_same_bits_with_any_number_of_threads(threads: None) -> None:
    case = asking(case_of(STANDARD, 3000))
    found = []
    for count in (1, 2, 3, 1):
        torch.set_num_threads(count)
        gaussians = by_kernels(case)
        found.append([*(getattr(gaussians, name) for name in OUTPUTS), *gradients(case, gaussians).values()])
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


def test_what_one_step_keeps_the_next_does_not_overwrite() -> None:
    """Outputs and gradients live in memory that is used again."""
    first, second = asking(case_of(STANDARD, 100)), asking(case_of(STANDARD, 100, seed=1))
    gaussians = by_kernels(first)
    kept = {name: getattr(gaussians, name).clone() for name in OUTPUTS}
    found = gradients(first, gaussians)
    copies = {name: gradient.clone() for name, gradient in found.items()}
    gradients(second, by_kernels(second))
    assert all(torch.equal(getattr(gaussians, name), kept[name]) for name in OUTPUTS)
    assert all(torch.equal(found[name], copies[name]) for name in found)
