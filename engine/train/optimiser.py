"""Adam over anchors and decoders, with log-linear learning rates. It survives growth and pruning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch.optim.adam import adam

from ..model.anchors import Anchors
from ..model.decoders import Decoders

Rates = Mapping[str, tuple[float, float]]
"""Start and end of the log-linear decay of each learning rate, by name."""
RATES: Rates = {
    "feature": (0.0075, 0.0075),
    "offset": (0.01, 1e-4),  # times the scene's extent in metres
    "log_scale": (0.007, 0.007),
    "opacity": (0.002, 2e-5),
    "covariance": (0.004, 0.004),
    "colour": (0.008, 5e-5),
    "semantic": (0.004, 4e-4),
    "instance": (0.004, 4e-4),
}
"""Scaffold-GS's rates, and ours for the two label decoders."""


def learning_rate(ends: tuple[float, float], progress: float) -> float:
    """The learning rate for ``progress`` in [0, 1], log-linear between the two ends."""
    start, end = ends
    return math.exp(math.log(start) * (1 - progress) + math.log(end) * progress)


Moments = tuple[torch.Tensor, torch.Tensor]
"""The running means of a parameter's gradients and of their squares, in the parameter's shape."""


@torch.no_grad()
def adam_step(
    parameters: Sequence[torch.Tensor], moments: Sequence[Moments], count: int, rate: float, *, eps: float, fused: bool
) -> None:
    """Move ``parameters`` along their gradients, update ``moments`` in place and drop the gradients.

    ``count`` steps came before. The moments of a parameter without a gradient decay. torch's own class Adam
    imports torch's compiler, which takes 3 s.
    """
    gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in parameters]
    means, squares = [mean for mean, _ in moments], [square for _, square in moments]
    counts = [torch.tensor(float(count)) for _ in parameters]
    adam(
        list(parameters), gradients, means, squares, [], counts, foreach=False, fused=fused, amsgrad=False,
        beta1=0.9, beta2=0.999, lr=rate, weight_decay=0.0, eps=eps, maximize=False,
    )  # fmt: skip
    for parameter in parameters:
        parameter.grad = None


def no_moments(parameter: torch.Tensor) -> Moments:
    """The moments of a parameter before its first step."""
    return torch.zeros_like(parameter), torch.zeros_like(parameter)


class Optimiser:
    """Adam (eps 1e-15, as in Scaffold-GS). State is kept by name, so that it can be stored, restored and cut."""

    def __init__(self, anchors: Anchors, decoders: Decoders, rates: Rates, extent: float) -> None:
        self.anchors, self.decoders, self.rates, self.extent = anchors, decoders, rates, extent
        self.moments: dict[str, Moments] = {}
        self.count = 0
        for name in Anchors.LEARNT:
            getattr(anchors, name).requires_grad_()

    def _named(self) -> Iterator[tuple[str, torch.Tensor]]:
        for name in Anchors.LEARNT:
            yield f"anchors.{name}", getattr(self.anchors, name)
        for name, parameter in self.decoders.named_parameters():
            yield f"decoders.{name}", parameter

    def step(self, progress: float) -> None:
        """Do one Adam step with the current gradients; ``progress`` is the share of all steps done."""
        names = {id(parameter): name for name, parameter in self._named()}
        groups = [(name, [getattr(self.anchors, name)]) for name in Anchors.LEARNT]
        for group, parameters in (*groups, *self.decoders.learnt()):
            rate = learning_rate(self.rates[group], progress) * (self.extent if group == "offset" else 1.0)
            for each in parameters:
                if names[id(each)] not in self.moments:
                    self.moments[names[id(each)]] = no_moments(each)
            moments = [self.moments[names[id(each)]] for each in parameters]
            adam_step(parameters, moments, self.count, rate, eps=1e-15, fused=True)
        self.count += 1

    def replace_anchors(self, anchors: Anchors, keep: torch.Tensor) -> None:
        """Continue with ``anchors``: rows ``keep`` (bool over the old ones), then new ones with moments of 0."""
        self.anchors = anchors
        for name in Anchors.LEARNT:
            parameter, moments = getattr(anchors, name).requires_grad_(), self.moments.get(f"anchors.{name}")
            if moments is not None:
                mean, square = (_resized(each[keep], parameter.shape) for each in moments)
                self.moments[f"anchors.{name}"] = mean, square

    def tensors(self) -> dict[str, torch.Tensor]:
        """First and second moments by parameter name."""
        tensors = {}
        for name, (mean, square) in self.moments.items():
            tensors[f"{name}.mean"], tensors[f"{name}.square"] = mean, square
        return tensors

    def restore(self, tensors: dict[str, torch.Tensor], count: int) -> None:
        """Restore the moments that ``tensors()`` returned after ``count`` steps."""
        self.count = count
        self.moments = {
            name: (tensors[f"{name}.mean"].clone(), tensors[f"{name}.square"].clone())
            for name, _ in self._named()
            if f"{name}.mean" in tensors
        }


def _resized(rows: torch.Tensor, size: torch.Size) -> torch.Tensor:
    grown = torch.zeros(size)
    grown[: len(rows)] = rows
    return grown
