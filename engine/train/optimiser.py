"""Adam over anchors and decoders, with log-linear learning rates, that survives growing and pruning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import torch

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
"""Scaffold-GS's, and ours for the two label decoders."""


def learning_rate(ends: tuple[float, float], progress: float) -> float:
    """Log-linear between the two ends for ``progress`` in [0, 1]."""
    start, end = ends
    return math.exp(math.log(start) * (1 - progress) + math.log(end) * progress)


class Optimiser:
    """Adam (eps 1e-15, Scaffold-GS). State is kept by name, so that it can be stored, restored and cut."""

    def __init__(self, anchors: Anchors, decoders: Decoders, rates: Rates, extent: float) -> None:
        self.rates, self.extent = rates, extent
        self.moments: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
        self.count = 0
        self._bind(anchors, decoders)

    def _bind(self, anchors: Anchors, decoders: Decoders) -> None:
        self.anchors, self.decoders = anchors, decoders
        groups = []
        for name, parameters in self._groups():
            groups.append({"params": parameters, "name": name, "lr": 0.0})
        self.adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)
        for name, parameter in self._named():
            if name in self.moments:
                mean, square = self.moments[name]
                self.adam.state[parameter] = {
                    "step": torch.tensor(float(self.count)),
                    "exp_avg": mean,
                    "exp_avg_sq": square,
                }

    def _groups(self) -> Iterator[tuple[str, Sequence[torch.Tensor]]]:
        for name in Anchors.LEARNT:
            yield name, [getattr(self.anchors, name).requires_grad_()]
        yield from self.decoders.learnt()

    def _named(self) -> Iterator[tuple[str, torch.Tensor]]:
        for name in Anchors.LEARNT:
            yield f"anchors.{name}", getattr(self.anchors, name)
        for name, parameter in self.decoders.named_parameters():
            yield f"decoders.{name}", parameter

    def step(self, progress: float) -> None:
        """One Adam step from the gradients at hand; ``progress`` is the share of all steps done."""
        for group in self.adam.param_groups:
            rate = learning_rate(self.rates[group["name"]], progress)
            group["lr"] = rate * self.extent if group["name"] == "offset" else rate
            for parameter in group["params"]:
                if parameter.grad is None:  # a decoder that took no part: its moments fade, and all count their steps
                    parameter.grad = torch.zeros_like(parameter)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        self.count += 1

    def rebound(self, anchors: Anchors, decoders: Decoders) -> Optimiser:
        """A fresh optimiser of the same rates for other parameters."""
        return Optimiser(anchors, decoders, self.rates, self.extent)

    def replace_anchors(self, anchors: Anchors, keep: torch.Tensor) -> None:
        """Go on with ``anchors``: rows ``keep`` (bool over the old ones), then new ones, whose moments start at 0."""
        moments = self.tensors()
        self.moments = {}
        for name, _ in self._named():
            if f"{name}.mean" not in moments:
                continue
            mean, square = moments[f"{name}.mean"], moments[f"{name}.square"]
            if name.startswith("anchors."):
                size = getattr(anchors, name.removeprefix("anchors.")).shape
                mean, square = _resized(mean[keep], size), _resized(square[keep], size)
            self.moments[name] = (mean, square)
        self._bind(anchors, self.decoders)

    def tensors(self) -> dict[str, torch.Tensor]:
        """First and second moments by parameter name."""
        tensors = {}
        for name, parameter in self._named():
            state = self.adam.state.get(parameter)
            if state:
                tensors[f"{name}.mean"], tensors[f"{name}.square"] = state["exp_avg"], state["exp_avg_sq"]
        return tensors

    def restore(self, tensors: dict[str, torch.Tensor], count: int) -> None:
        """Take up the moments that ``tensors()`` gave after ``count`` steps."""
        self.count = count
        self.moments = {
            name: (tensors[f"{name}.mean"].clone(), tensors[f"{name}.square"].clone())
            for name, _ in self._named()
            if f"{name}.mean" in tensors
        }
        self._bind(self.anchors, self.decoders)


def _resized(rows: torch.Tensor, size: torch.Size) -> torch.Tensor:
    grown = torch.zeros(size)
    grown[: len(rows)] = rows
    return grown
