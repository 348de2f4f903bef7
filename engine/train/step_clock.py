"""Where the time of a training step goes."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch
from torch.autograd.graph import register_multi_grad_hook


class StepClock:
    """Is told where the parts of a step end, and pays no heed."""

    def start(self) -> None:
        """A step begins."""

    def lap(self, part: str) -> None:
        """What was done since the last call was ``part``."""

    def lap_on_way_back(self, tensors: Sequence[torch.Tensor], part: str) -> None:
        """To do the same when the backward pass first comes to one of ``tensors``."""


class MeasuringClock(StepClock):
    """Keeps the wall seconds of each part of each step in ``steps``. A part told twice in a step adds up."""

    def __init__(self) -> None:
        self.steps: list[dict[str, float]] = []
        self._last = 0.0

    def start(self) -> None:
        self.steps.append({})
        self._last = time.perf_counter()

    def lap(self, part: str) -> None:
        now = time.perf_counter()
        parts = self.steps[-1]
        parts[part] = parts.get(part, 0.0) + now - self._last
        self._last = now

    def lap_on_way_back(self, tensors: Sequence[torch.Tensor], part: str) -> None:
        # Nodes run back in the order in which they were made, so all of what came after goes before.
        register_multi_grad_hook(tensors, lambda gradient: self.lap(part), mode="any")
