"""What a set-up is asked for, how far it is, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...engine.job import JobError


@dataclass(frozen=True)
class Wish:
    """What to make. ``base_python`` None: the first that can. ``torch_build``: "cpu" or "cuda". ``index_url`` empty:
    packages come from where pip is configured to look.
    """

    base_python: Path | None = None
    torch_build: str = "cpu"
    index_url: str = ""


@dataclass(frozen=True)
class Progress:
    """How far it is: ``step`` counts from 1; ``fraction`` of the whole is a guess from what lies on the disk."""

    step: int = 1
    steps: int = 6
    label: str = "Starting"
    detail: str = ""
    fraction: float = 0.0
    bytes_on_disk: int = 0
    elapsed_s: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """How it ended: the environment's Python, or an error, or neither when it was cancelled."""

    python: Path | None = None
    error: JobError | None = None


@dataclass(frozen=True)
class Share:
    """The part of the whole that a step takes, and how its own progress is guessed: by bytes, or by time."""

    start: float
    end: float
    bytes_at_start: int = 0
    bytes_expected: float = 0.0
    began: float = 0.0
    seconds_expected: float = 0.0

    def fraction(self, bytes_on_disk: int, now: float) -> float:
        """Of the whole, given the bytes on the disk and the time of the clock."""
        share = 0.0
        if self.bytes_expected:
            share = (bytes_on_disk - self.bytes_at_start) / self.bytes_expected
        elif self.seconds_expected:
            share = (now - self.began) / self.seconds_expected
        return self.start + (self.end - self.start) * min(1.0, max(0.0, share))
