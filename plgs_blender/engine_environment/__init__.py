"""The engine's Python: panels draw `status`, engines start with `usable_python`; `tasks` checks it and sets it up."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ...engine.errors import ErrorCode, PlgsError
from ...engine.job.process import ROOT, choose_python
from ...engine.job.process import engine_python as find_engine_python
from .choices import chosen_python, studio
from .tasks import EngineState, EngineStatus, running_set_up, status


def why_no_engine() -> str | None:
    """Return why no engine can be started now, or None if one can. Never reads the disk."""
    engine = status()
    if not engine.is_usable and running_set_up() is not None:
        return "The engine is being set up: it takes some minutes"
    return None if engine.is_usable else f"{engine.message}. {engine.fix}"


def usable_python() -> Path:
    """Return the last Python that answered; without a window, ask one now, in 0.1 s. Raises PlgsError if none does."""
    known = status()
    if known.state is EngineState.READY and known.python is not None:
        return known.python
    if bpy.app.background:
        return find_engine_python(ROOT, os.environ, chosen_python())
    if not known.is_usable:
        raise PlgsError("no-engine", known.message, known.python or "the engine", known.fix, code=ErrorCode.NO_ENGINE)
    return _python_to_be_asked()


def engine_python() -> Path | None:
    """Return `usable_python`, or None if there is none; `status` then says why."""
    known = status()
    try:
        if known.state is EngineState.CHECKING:  # the answer comes in a moment; a caller that needs it now may try
            return _python_to_be_asked()
        return usable_python() if known.is_usable else None
    except PlgsError:
        return None


def _python_to_be_asked() -> Path:
    return choose_python(ROOT, os.environ, chosen_python()).python
