"""What is known about the engine, as text for users."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from ...engine.errors import PlgsError
from ...engine.job.handshake import TOO_OLD, VERSION, EngineAnswer
from ...engine.job.process import ChosenPython, Origin

_SET_UP = "Press 'Set Up Engine' in Preferences > Add-ons > PLGS, or choose a Python there that has what it needs."
_OTHER_PYTHON = "Choose another Python, or set the engine up."


class EngineState(Enum):
    """How much is known about the engine."""

    UNKNOWN = "unknown"
    CHECKING = "checking"
    READY = "ready"
    MISSING = "missing"
    FAILED = "failed"


@dataclass(frozen=True)
class EngineStatus:
    """One line for the user, and a fix if the engine cannot be used. ``note`` mentions what is unusual but may work."""

    state: EngineState
    message: str = ""
    fix: str = ""
    note: str = ""
    python: Path | None = None
    answer: EngineAnswer | None = None

    @property
    def is_usable(self) -> bool:
        """Whether nothing known prevents its use."""
        return self.state not in (EngineState.MISSING, EngineState.FAILED)


UNKNOWN = EngineStatus(EngineState.UNKNOWN, "The engine has not been checked yet", "Check the engine.")


def checking(choice: ChosenPython) -> EngineStatus:
    """The status while a Python is being checked."""
    return EngineStatus(EngineState.CHECKING, "Asking the engine", python=choice.python)


def without_python(error: PlgsError) -> EngineStatus:
    """The status if no Python could run the engine."""
    return EngineStatus(EngineState.MISSING, _capital(error.what), _SET_UP)


def of_answer(choice: ChosenPython, answer: Mapping[str, Any] | None) -> EngineStatus:
    """The status after a Python answered; None if it ended without an answer."""
    engine = EngineAnswer.from_json(answer or {})
    if engine is None:
        message = f"{choice.python} answers, but not as a Python with this engine should"
        return failed(choice, message, "Choose another Python.")
    if engine.engine != VERSION:
        message = f"engine {engine.engine} does not match this PLGS, which is {VERSION}"
        return failed(choice, message, "Restart Blender: PLGS was updated while Blender was running.")
    if engine.missing:
        message = f"{choice.python} ({choice.origin}) lacks {', '.join(engine.missing)}"
        fix = choice.fix if choice.origin is Origin.VARIABLE else _SET_UP
        return EngineStatus(EngineState.MISSING, message, fix, "", choice.python, engine)
    note = f"Versions that differ from the tested ones: {', '.join(engine.others)}" if engine.others else ""
    return EngineStatus(EngineState.READY, _describe(engine), "", note, choice.python, engine)


def of_error(choice: ChosenPython, error: PlgsError) -> EngineStatus:
    """The status if a Python cannot run the engine."""
    if TOO_OLD in error.what:
        return failed(choice, error.what, "Choose a newer Python, or set the engine up.")
    return failed(choice, f"{choice.python} does not run the engine ({str(error)[:200]})", _OTHER_PYTHON)


def without_answer(choice: ChosenPython) -> EngineStatus:
    """The status if a Python did not answer in time."""
    return failed(choice, f"{choice.python} did not answer", "Check the engine again, or choose another Python.")


def failed(choice: ChosenPython, message: str, fix: str) -> EngineStatus:
    """The status if no engine answers."""
    fix = fix if choice.origin is Origin.CHOSEN else f"{fix} {choice.fix}"
    return EngineStatus(EngineState.FAILED, _capital(message), fix, "", choice.python)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _describe(answer: EngineAnswer) -> str:
    build = f"CUDA {answer.cuda}" if answer.cuda else "CPU"
    torch = (answer.packages["torch"] or "").partition("+")[0]
    cores = "1 core" if answer.cpus == 1 else f"{answer.cpus} cores"
    return f"Engine {answer.engine}, Python {answer.python}, torch {torch} ({build}), {cores}"
