"""Report progress and a lift's stages as events, with an estimate of the time left."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from .events import EventWriter
from .task import StopSignal

log = logging.getLogger("plgs.job")

Progress = Callable[[int, int], object]
"""Called with (done, total); may raise to stop."""
REPORT_EVERY_S = 0.2
"""Progress events are written no more often than this."""
_TRUSTED = 0.1
"""Share of the whole run after which the predicted pace counts as much as the measured one."""
_SURE = 0.2
"""Share of a stage after which its own pace alone predicts how long it still takes."""


def unwatched(done: int, total: int) -> None:
    """Take progress and do nothing: the default callback where nobody follows the work."""


def part_of(whole: Progress, begin: float, end: float, steps: int = 0) -> Progress:
    """Return a progress callback for a part of the work, which lies between the fractions ``begin`` and ``end`` of
    ``whole``. ``whole`` is called with ``steps`` as the total; 0 means the part's own total."""
    size = end - begin
    return lambda done, total: whole(round((steps or total) * (begin + size * done / (total or 1))), steps or total)


class Course:
    """Estimates how long a run still takes. ``seconds`` are the predicted times of its stages from now on, in order."""

    def __init__(self, seconds: Mapping[str, float]) -> None:
        self.began, self.seconds = time.monotonic(), dict(seconds)

    def leave_out(self, seconds: float) -> None:
        """Exclude ``seconds`` from the measured pace: kernels were compiled then, which happens only once."""
        self.began += seconds

    def skip(self, stage: str, share: float) -> None:
        """Count this share of a stage as done already, because the lift was resumed."""
        self.began -= share * self.seconds[stage]

    def left(self, stage: str, share: float, eta: float | None, now: float) -> float | None:
        """Return the seconds left in the run at the time ``now``, when ``share`` of a stage is done and ``eta`` seconds
        of it are left; None for a stage without a prediction."""
        if stage not in self.seconds:
            return None
        values, index = [*self.seconds.values()], [*self.seconds].index(stage)
        done = sum(values[:index]) + share * values[index]
        trusted = _TRUSTED * sum(values)
        pace = (now - self.began + trusted) / (done + trusted)  # 1 is as predicted
        own = pace * (1.0 - share) * values[index]
        if eta is not None:
            own += min(1.0, share / _SURE) * (eta - own)
        return round(own + pace * sum(values[index + 1 :]), 1)


class StageProgress:
    """The progress callback (done, total, loss) of a stage. It raises Cancelled when the lift should stop. If ``done``
    falls, a new part of the stage has begun, with a pace of its own. ``course`` knows the time of the later stages."""

    def __init__(self, name: str, events: EventWriter, stop: StopSignal, course: Course | None = None) -> None:
        self.name, self.events, self.stop, self.course = name, events, stop, course
        self.began = self.reported = time.monotonic()
        self.first: int | None = None
        self.last: int | None = None

    def __call__(self, done: int, total: int, loss: float | None = None) -> None:
        self.stop.check()
        now = time.monotonic()
        if self.first is None or done < (self.last or 0):
            self.first, self.began = done, now
        if now - self.reported < REPORT_EVERY_S and (done < total or done == self.last):  # the end always, once
            return
        self.reported, self.last = now, done
        counted = done - self.first  # None before there is a pace; then the mean pace of this run so far
        eta = round((total - done) * (now - self.began) / counted, 1) if counted else None
        whole = None if self.course is None else self.course.left(self.name, done / max(total, 1), eta, now)
        self.events.progress(self.name, done, total, loss=loss, eta_s=eta, left_s=whole)

    def part(self, begin: float, end: float) -> Progress:
        """Return a progress callback (done, total) for the part of the stage between the shares ``begin`` and ``end``.
        It reports whole percentages."""
        return part_of(self, begin, end, 100)


class StageReporter:
    """Announces the stages in order, records their seconds in ``timings``, and logs their processor time. Once it has a
    ``course``, events also tell how long the whole run still takes."""

    def __init__(self, events: EventWriter, stop: StopSignal, labels: Mapping[str, str]) -> None:
        self.events, self.stop, self.labels = events, stop, labels
        self.timings: dict[str, float] = {}
        self.course: Course | None = None

    @contextmanager
    def stage(self, name: str, label: str = "") -> Iterator[StageProgress]:
        """Announce the stage ``name``, or a part of it that has a ``label`` of its own, and time it."""
        self.stop.check()
        self.events.stage(name, list(self.labels).index(name) + 1, len(self.labels), label or self.labels[name])
        began, used = time.monotonic(), time.process_time()
        yield StageProgress(name, self.events, self.stop, self.course)
        self.timings[name] = round(time.monotonic() - began, 3)
        took = time.process_time() - used
        log.info("stage %s: %.2f s; processor time %.2f s, before it %.2f s", name, self.timings[name], took, used)
