"""Stages and progress of a lift as events, with an estimate of the time left; and the parts of a training step."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch

from ..job import EventWriter, StopSignal

REPORT_EVERY_S = 0.2
"""Progress events are written no more often than this."""


class StageProgress:
    """Called with (done, total, loss) inside a stage; raises Cancelled when the lift shall stop."""

    def __init__(self, name: str, events: EventWriter, stop: StopSignal) -> None:
        self.name, self.events, self.stop = name, events, stop
        self.began = self.reported = time.monotonic()
        self.first: int | None = None
        self.last: int | None = None

    def __call__(self, done: int, total: int, loss: float | None = None) -> None:
        self.stop.check()
        now = time.monotonic()
        if self.first is None:
            self.first, self.began = done, now
        if now - self.reported < REPORT_EVERY_S and (done < total or done == self.last):
            return
        self.reported, self.last = now, done
        self.events.progress(self.name, done, total, loss=loss, eta_s=self._remaining(done, total, now))

    def _remaining(self, done: int, total: int, now: float) -> float | None:
        """Seconds left at the mean pace of this run so far; None before there is a pace."""
        assert self.first is not None
        counted = done - self.first
        return round((total - done) * (now - self.began) / counted, 1) if counted else None


class StageReporter:
    """Announces the stages in their order and keeps how long each took (``timings``, seconds)."""

    def __init__(self, events: EventWriter, stop: StopSignal, labels: Mapping[str, str]) -> None:
        self.events, self.stop, self.labels = events, stop, labels
        self.timings: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[StageProgress]:
        """Announce the stage ``name`` and time it."""
        self.stop.check()
        self.events.stage(name, list(self.labels).index(name) + 1, len(self.labels), self.labels[name])
        began = time.monotonic()
        yield StageProgress(name, self.events, self.stop)
        self.timings[name] = round(time.monotonic() - began, 3)


class StepClock:
    """Is called where a part of a training step ends. This one does nothing; ``research/bench/step.py`` measures."""

    def start(self) -> None:
        """A step begins."""

    def lap(self, part: str) -> None:
        """The part of the step since the last call was ``part``."""

    def lap_on_way_back(self, tensors: Sequence[torch.Tensor], part: str) -> None:
        """``lap`` when the backward pass first reaches one of ``tensors``."""
