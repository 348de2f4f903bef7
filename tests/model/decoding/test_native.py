"""What is the kernels' own; tests/model/test_torch_decoding.py compares them with torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from engine.model import gaussians as dispatch
from tests.model.decoding_cases import (
    OUTPUTS,
    STANDARD,
    asking,
    assert_matches,
    by_kernels,
    by_torch,
    case_of,
    gradients,
)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("visible", [7, 64])
def test_batches_of_any_size_match_torch(visible: int) -> None:
    assert_matches(by_kernels, case_of(STANDARD, visible))


@pytest.mark.parametrize("options", [(False, True), (True, False), (True, True)])
def test_both_options(options: tuple[bool, bool]) -> None:
    distance, labels = options
    assert_matches(by_kernels, case_of(replace(STANDARD, distance_input=distance, label_view_input=labels), 70))


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


@pytest.mark.parametrize("kind", ["float64", "plain"])
def test_the_kernels_decode_probabilities_in_float32(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "decode_natively", lambda *asked: pytest.fail("by kernels"))
    case = case_of(STANDARD, 20)
    if kind == "plain":
        with pytest.raises(pytest.fail.Exception, match="by kernels"):
            by_kernels(case)
        return
    case = case.in_double()
    assert torch.equal(by_kernels(case).labels, by_torch(case).labels)
