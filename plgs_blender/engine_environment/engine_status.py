"""What is known of the engine, in words for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from ...engine.job import JobError
from ...engine.job.handshake import EngineAnswer
from ...engine.job.process import ChosenPython, Origin
from .handshake import NoAnswer

_SET_UP = "Press 'Set up engine' in the add-on's preferences, or choose a Python there that has what it needs."


class EngineState(Enum):
    """Of the engine, as far as anybody looked."""

    UNKNOWN = "unknown"
    CHECKING = "checking"
    READY = "ready"
    MISSING = "missing"
    FAILED = "failed"


@dataclass(frozen=True)
class EngineStatus:
    """One line for people, and what to do where the engine cannot be used. ``note``: what is odd, but may work."""

    state: EngineState
    message: str = ""
    fix: str = ""
    note: str = ""
    python: Path | None = None
    answer: EngineAnswer | None = None

    @property
    def is_usable(self) -> bool:
        """Nothing is known that speaks against it."""
        return self.state not in (EngineState.MISSING, EngineState.FAILED)


UNKNOWN = EngineStatus(EngineState.UNKNOWN, "The engine was not asked yet", "Check the engine.")


def checking(choice: ChosenPython) -> EngineStatus:
    """While a Python is asked."""
    return EngineStatus(EngineState.CHECKING, "Asking the engine", python=choice.python)


def without_python(error: JobError) -> EngineStatus:
    """Nothing is there that could run it."""
    return EngineStatus(EngineState.MISSING, error.what[:1].upper() + error.what[1:], _SET_UP)


def status_of(choice: ChosenPython, answer: EngineAnswer | NoAnswer) -> EngineStatus:
    """What a Python's answer means."""
    if isinstance(answer, NoAnswer):
        fix = answer.fix if choice.origin is Origin.CHOSEN else f"{answer.fix} {choice.fix}"
        return EngineStatus(EngineState.FAILED, answer.message[:1].upper() + answer.message[1:], fix, "", choice.python)
    if answer.missing:
        message = f"{choice.python} ({choice.origin}) lacks {', '.join(answer.missing)}"
        fix = choice.fix if choice.origin is Origin.VARIABLE else _SET_UP
        return EngineStatus(EngineState.MISSING, message, fix, "", choice.python, answer)
    note = f"Other versions than the tested ones: {', '.join(answer.others)}" if answer.others else ""
    return EngineStatus(EngineState.READY, _describe(answer), "", note, choice.python, answer)


def _describe(answer: EngineAnswer) -> str:
    build = f"CUDA {answer.cuda}" if answer.cuda else "CPU"
    torch = (answer.packages["torch"] or "").partition("+")[0]
    cores = "1 core" if answer.cpus == 1 else f"{answer.cpus} cores"
    return f"Engine {answer.version}, Python {answer.python}, torch {torch} ({build}), {cores}"
