"""Ask a Python whether the engine answers in it: a process that is polled."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from ...engine.job import JobError
from ...engine.job.handshake import TOO_OLD, VERSION, EngineAnswer
from ...engine.job.process import ROOT, EngineProcess, engine_call

PATIENCE_S = 10.0
"""An answer takes a few tenths of a second, the first one from a cold disk a few seconds."""


class Reason(StrEnum):
    """Why no engine answers."""

    DOES_NOT_RUN = "does not run"
    WRONG_PYTHON = "wrong Python version"
    OTHER_VERSION = "other version"
    HUNG = "no answer"
    GARBAGE = "no engine"


@dataclass(frozen=True)
class NoAnswer:
    """No engine answers, why, and what to do."""

    reason: Reason
    message: str
    fix: str


class Handshake:
    """A question to one Python. Poll it until it returns something, then close it; it starts no threads."""

    def __init__(
        self,
        python: Path,
        root: Path = ROOT,
        *,
        patience_s: float = PATIENCE_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.python = python
        self._clock, self._give_up = clock, clock() + patience_s
        self._process: EngineProcess | None = None
        self._refused: JobError | None = None
        try:
            self._process = EngineProcess([*engine_call(python, root), "handshake"], root)
        except JobError as error:
            self._refused = error

    def poll(self) -> EngineAnswer | NoAnswer | None:
        """What came of it; None while there is nothing yet."""
        if self._process is None:
            assert self._refused is not None
            return NoAnswer(Reason.DOES_NOT_RUN, f"{self._refused.what}: {self.python}", self._refused.fix)
        code = self._process.exit_code()
        if code is None:
            return self._no_answer_in_time() if self._clock() > self._give_up else None
        output = self._process.output_tail()
        return self._answer(output) if code == 0 else self._refusal(output, code)

    def close(self) -> None:
        """Let go of the process; one that still runs is ended."""
        if self._process is not None:
            self._process.kill()
            self._process.close()
            self._process = None

    def _no_answer_in_time(self) -> NoAnswer:
        message = f"{self.python} did not answer"
        return NoAnswer(Reason.HUNG, message, "Check the engine again, or choose another Python.")

    def _answer(self, output: str) -> EngineAnswer | NoAnswer:
        answer = EngineAnswer.from_line(output.splitlines()[-1]) if output else None
        if answer is None:
            message = f"{self.python} answers, but not as a Python with this engine does"
            return NoAnswer(Reason.GARBAGE, message, "Choose another Python.")
        if answer.version != VERSION:
            message = f"engine {answer.version} does not belong to this PLGS, which is {VERSION}"
            return NoAnswer(Reason.OTHER_VERSION, message, "Restart Blender: PLGS was updated while it ran.")
        return answer

    def _refusal(self, output: str, code: int) -> NoAnswer:
        last = output.splitlines()[-1] if output else f"exit code {code}"
        if TOO_OLD in last:
            message = last.removeprefix("error: ")
            return NoAnswer(Reason.WRONG_PYTHON, message, "Choose a newer Python, or set the engine up.")
        message = f"{self.python} does not run the engine ({last[:200]})"
        return NoAnswer(Reason.DOES_NOT_RUN, message, "Choose another Python, or set the engine up.")
