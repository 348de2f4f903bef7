"""A set-up in a thread, as a command runs it in a process of its own."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from engine.errors import Cancelled, PlgsError
from engine.job import EventReader, EventWriter, StopSignal
from engine.set_up import SetUp, SetUpRequest
from tests.waiting import PATIENCE_S, wait_until


class RunningSetUp:
    """``python`` and ``error`` say how it ended; both are None while it goes on, and after a cancel."""

    def __init__(self, request: SetUpRequest, code: Path, folder: Path) -> None:
        self._events = Path(tempfile.mkdtemp(prefix="plgs-test-")) / "events.jsonl"
        self._stop = StopSignal()
        self.set_up = SetUp(request, EventWriter(self._events), self._stop, code, folder)
        self.python: Path | None = None
        self.error: PlgsError | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.python = self.set_up.run()
        except PlgsError as error:
            self.error = error
        except Cancelled:
            pass

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    @property
    def labels(self) -> list[str]:
        """The labels of all steps until now."""
        return [str(event.data["label"]) for event in EventReader(self._events).poll() if event.kind == "stage"]

    @property
    def label(self) -> str:
        """The label of the step that it is at."""
        return (self.labels or [""])[-1]

    @property
    def fractions(self) -> list[float]:
        """How much was done at each moment until now, of 1."""
        events = EventReader(self._events).poll()
        return [event.data["step"] / event.data["steps"] for event in events if event.kind == "progress"]  # type: ignore[operator]

    def wait(self, until: Callable[[], bool] | None = None) -> RunningSetUp:
        """Wait for its end, or until something holds. It may not end before that."""

        def is_over() -> bool:
            has_ended = not self.is_running  # asked first: at its end it may come to hold
            if until is None or until():
                return until is not None or has_ended
            assert not has_ended, self.error or self.labels
            return False

        wait_until(is_over, lambda: self.labels)
        return self

    def cancel(self) -> None:
        """Stop it as the cancel file does."""
        self._stop.ask("the test is over")
        self._thread.join(PATIENCE_S)
        assert not self.is_running
