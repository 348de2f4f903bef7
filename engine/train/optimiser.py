"""Adam for anchors and decoders, with log-linear learning rates; continues when anchors are added or pruned.

A step moves only the anchors that its view decodes, and only their moments decay. Scaffold-GS moves all: an anchor that
the view does not show then drifts on with the moments of earlier views. If a view sees every anchor, both are equal."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import torch
from torch.optim.adam import adam

from ..machine.compiled import Array, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from ..machine.vectors import WIDTH, broadcast, fma, lane_numbers, masked_load, masked_store, square_root
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
    """Return the learning rate at ``progress`` in [0, 1], log-linear between the ``ends`` (first and last rate)."""
    start, end = ends
    return math.exp(math.log(start) * (1 - progress) + math.log(end) * progress)


BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
"""Adam's constants, as in Scaffold-GS."""
Moments = tuple[torch.Tensor, torch.Tensor]
"""The running means of a parameter's gradients and of their squares, in the parameter's shape."""


@torch.no_grad()
def adam_step(
    parameters: Sequence[torch.Tensor], moments: Sequence[Moments], count: int, rate: float, *, eps: float, fused: bool
) -> None:
    """Move ``parameters`` by one Adam step, update ``moments`` in place and clear the gradients. ``count``: earlier
    steps; ``fused``: in one kernel. If a parameter has no gradient, its moments only decay. Used in place of torch's
    own class Adam, which imports torch's compiler and takes 3 s for it."""
    gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in parameters]
    means, squares = [mean for mean, _ in moments], [square for _, square in moments]
    counts = [each.new_full((), float(count)) for each in parameters]
    adam(
        list(parameters), gradients, means, squares, [], counts, foreach=False, fused=fused, amsgrad=False,
        beta1=BETA_1, beta2=BETA_2, lr=rate, weight_decay=0.0, eps=eps, maximize=False,
    )  # fmt: skip
    for parameter in parameters:
        parameter.grad = None


@torch.no_grad()
def move_rows(
    parameter: torch.Tensor,  # [M, ...]
    moments: Moments,
    rows: torch.Tensor,  # int64 [V]
    count: int,
    rate: float,
) -> None:
    """Do one Adam step, as ``adam_step`` does, but only for these ``rows`` of one parameter, float32 on the CPU. Other
    rows and their moments do not change. Clears the gradient."""
    if parameter.grad is None:
        return
    tensors = (*moments, parameter.grad.contiguous(), parameter.detach())
    rate, root = rate / (1 - BETA_1 ** (count + 1)), math.sqrt(1 - BETA_2 ** (count + 1))
    factors = np.array([BETA_1, 1 - BETA_1, BETA_2, 1 - BETA_2, rate, 1 / root, EPSILON], np.float32)
    mean, square, gradient, values = (tensor.view(-1).numpy() for tensor in tensors)
    columns = len(values) // max(len(parameter), 1)
    parallel_for(worker_count(), _move_rows, rows.numpy(), columns, factors, (mean, square), gradient, values)
    parameter.grad = None


@parallel_kernel
def _move_rows(
    worker: int, workers: int, rows: Array, columns: int, factors: Array, moments: tuple[Array, Array],
    gradient: Array, values: Array,
) -> None:  # fmt: skip
    """Do one thread's part of ``move_rows``, compiled. ``moments``, ``gradient`` and ``values`` are flat, [M *
    ``columns``]; ``factors`` [7] are Adam's constants in the order in which they are read."""
    mean, square = moments
    keep_mean, add_mean, keep_square, add_square = factors[0], factors[1], factors[2], factors[3]
    rate, over_root, epsilon = broadcast(factors[4]), broadcast(factors[5]), broadcast(factors[6])
    for index in range(len(rows) * worker // workers, len(rows) * (worker + 1) // workers):
        for column in range(0, columns, WIDTH):
            at, inside = rows[index] * columns + column, lane_numbers() < broadcast(np.float32(columns - column))
            slope = masked_load(gradient, at, inside)
            first = broadcast(keep_mean) * masked_load(mean, at, inside) + broadcast(add_mean) * slope
            second = broadcast(keep_square) * masked_load(square, at, inside) + broadcast(add_square) * (slope * slope)
            moved = rate * first / fma(square_root(second), over_root, epsilon)
            masked_store(mean, at, first, inside)
            masked_store(square, at, second, inside)
            masked_store(values, at, masked_load(values, at, inside) - moved, inside)


def no_moments(parameter: torch.Tensor) -> Moments:
    """Return a parameter's moments before its first step: zeros."""
    return torch.zeros_like(parameter), torch.zeros_like(parameter)


class Optimiser:
    """Adam for anchors and decoders. Moments are kept by parameter name, so that they can be saved and restored, and
    follow when anchors are added or removed."""

    def __init__(self, anchors: Anchors, decoders: Decoders, rates: Rates, extent: float) -> None:
        self.decoders, self.rates, self.extent, self.count = decoders, rates, extent, 0
        self.moments: dict[str, Moments] = {}
        self.move_to(anchors, anchors.position.device)

    def _named(self) -> Iterator[tuple[str, torch.Tensor]]:
        for name in Anchors.LEARNT:
            yield f"anchors.{name}", getattr(self.anchors, name)
        for name, parameter in self.decoders.named_parameters():
            yield f"decoders.{name}", parameter

    def step(
        self,
        progress: float,
        rows: torch.Tensor,  # int64 [V]
        move: Callable[..., None] = move_rows,
    ) -> None:
        """Do one Adam step with the current gradients, for the decoders and the anchors ``rows``. ``progress``: the
        share of all steps done, 0 to 1. ``move``: ``move_rows`` or `move_rows_in_torch`."""
        for name, each in self._named():
            if name not in self.moments and each.requires_grad:
                self.moments[name] = no_moments(each)
        for name in Anchors.LEARNT:
            rate = learning_rate(self.rates[name], progress) * (self.extent if name == "offset" else 1.0)
            move(getattr(self.anchors, name), self.moments[f"anchors.{name}"], rows, self.count, rate)
        names = {id(parameter): name for name, parameter in self._named()}
        for group, parameters in self.decoders.learnt():
            moments = [self.moments[names[id(each)]] for each in parameters]
            rate = learning_rate(self.rates[group], progress)
            adam_step(parameters, moments, self.count, rate, eps=EPSILON, fused=True)
        self.count += 1

    def move_to(self, anchors: Anchors, device: torch.device) -> None:
        """Continue on another ``device``, where ``anchors``, the same as before, and the decoders already are."""
        self.anchors = anchors
        for name in Anchors.LEARNT:
            getattr(anchors, name).requires_grad_()
        self.moments = {name: (mean.to(device), square.to(device)) for name, (mean, square) in self.moments.items()}

    def replace_anchors(
        self,
        anchors: Anchors,
        keep: torch.Tensor,  # bool [M], of the old anchors
    ) -> None:
        """Continue with ``anchors``: the old ones where ``keep``, followed by new ones, whose moments start at 0."""
        self.anchors = anchors
        for name in Anchors.LEARNT:
            parameter, moments = getattr(anchors, name).requires_grad_(), self.moments.get(f"anchors.{name}")
            if moments is not None:
                grown = no_moments(parameter)
                for new, old in zip(grown, moments, strict=True):
                    new[: int(keep.sum())] = old[keep]
                self.moments[f"anchors.{name}"] = grown

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the first and second moments of all parameters by name, for a checkpoint."""
        tensors = {}
        for name, (mean, square) in self.moments.items():
            tensors[f"{name}.mean"], tensors[f"{name}.square"] = mean, square
        return tensors

    def restore(self, tensors: dict[str, torch.Tensor], count: int) -> None:
        """Restore the moments that ``tensors()`` returned when ``count`` steps had been done."""
        self.count = count
        self.moments = {
            name: (tensors[f"{name}.mean"].clone(), tensors[f"{name}.square"].clone())  # steps change them in place
            for name, _ in self._named()
            if f"{name}.mean" in tensors  # a finished lift's checkpoint has no moments
        }
