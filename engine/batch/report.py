"""What a batch says while it runs: lines on standard error and, if a program listens, events."""

from __future__ import annotations

import sys
from dataclasses import asdict

from ..job import EventWriter
from ..job.task import TaskProgress
from ..job.terminal import LiveLine
from .plan import Row

BATCH = "batch"


class BatchReport:
    """Says the same on a line of the terminal and in ``events``. ``threads`` are those of a worker."""

    def __init__(self, events: EventWriter | None, threads: int) -> None:
        self._line, self._events = LiveLine(sys.stderr), events
        self._shown = (-1, -1)
        if events is not None:
            events.hello(threads=threads, resumed=False, task=BATCH)
            events.stage(BATCH, 1, 1, "Batch")

    def say(self, text: str) -> None:
        """A line that stays."""
        self._line.say(" ".join(text.splitlines()))
        if self._events is not None:
            self._events.warning(text)

    def show(self, done: int, scenes: int, running: str) -> None:
        """How many of the scenes are done, and what is at work."""
        label = f"Batch ({running})" if running else "Batch"
        self._line.show(TaskProgress(label=label, step=done, steps=scenes))
        if self._events is not None and (done, scenes) != self._shown:
            self._events.progress(BATCH, done, scenes)
        self._shown = done, scenes

    def ended(self, row: Row) -> None:
        """A scene has its row: the event "metric" with the name "scene"."""
        about = f": {row.reason}" if row.reason else f" in {row.seconds / 60:.1f} min"
        self._line.say(" ".join(f"{row.scene}: {row.state}{about}".splitlines()))
        if self._events is not None:
            figures = {name: value for name, value in row.metrics.items() if isinstance(value, int | float | str)}
            own = {name: value for name, value in asdict(row).items() if name != "metrics"}
            self._events.metric("scene", figures | own)

    def end(self) -> None:
        """What is printed next begins on a new line."""
        self._line.end()
