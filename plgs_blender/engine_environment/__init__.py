"""Which Python runs the engine, and whether it has what the engine needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...engine.job import JobError
from ...engine.job.process import engine_python as find_engine_python


@dataclass(frozen=True)
class EngineStatus:
    """One line for people, and what to do where the engine cannot be used."""

    is_usable: bool
    message: str = ""
    fix: str = ""


_status = EngineStatus(True)


def status() -> EngineStatus:
    """What is known of the engine. Looks at no disk."""
    return _status


def usable_python() -> Path:
    """The Python to run the engine with. Raises JobError when there is none that has what it needs."""
    return find_engine_python()


def engine_python() -> Path | None:
    """The same, or None; `status` then says why."""
    global _status
    try:
        python = usable_python()
    except JobError as error:
        _status = EngineStatus(False, f"{error.what}: {error.where}", error.fix)
        return None
    _status = EngineStatus(True)
    return python
