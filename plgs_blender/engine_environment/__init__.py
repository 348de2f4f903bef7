"""The engine's Python: which one, whether an engine answers in it, and how one is made.

`status` is what is known, for panels; `usable_python` is for whoever starts an engine. `session` follows what goes on,
`set_up` makes the environment, `handshake` asks. Only `session` and `choices` know Blender.
"""

from __future__ import annotations

import os
from pathlib import Path

from ...engine.job import JobError
from ...engine.job.process import ROOT, choose_python
from ...engine.job.process import engine_python as find_engine_python
from .choices import chosen_python
from .engine_status import EngineState, EngineStatus
from .session import status

__all__ = ["EngineState", "EngineStatus", "engine_python", "status", "usable_python"]


def usable_python() -> Path:
    """The Python to run the engine with. Raises JobError when there is none that has what it needs.

    At once when an engine answered already; otherwise it looks, which takes 0.1 s.
    """
    known = status()
    if known.state is EngineState.READY and known.python is not None:
        return known.python
    return find_engine_python(ROOT, os.environ, chosen_python())


def engine_python() -> Path | None:
    """The same without looking twice: None when it is known, or is found now, that no engine can be used."""
    known = status()
    try:
        if known.state is EngineState.CHECKING:  # the answer comes in a moment; who needs it now may try
            return choose_python(ROOT, os.environ, chosen_python()).python
        return usable_python() if known.is_usable else None
    except JobError:
        return None
