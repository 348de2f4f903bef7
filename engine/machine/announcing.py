"""Says that kernels are being compiled, once on each machine: it takes long, and nothing else shows."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path

from .compiled import CACHE_FOLDER, machine_target

log = logging.getLogger("plgs.machine")


def announce_compilation(what: str, how_long: str) -> Callable[[], None]:
    """Say so when kernels have yet to be compiled on this machine; call what is returned when they have
    been."""
    if is_compiled(what):
        return lambda: None
    say_that_it_compiles(what, how_long)
    return lambda: note_compiled(what)


def is_compiled(what: str) -> bool:
    """Whether ``note_compiled`` was ever called for these kernels on this machine."""
    return _stamp(what).exists()


def say_that_it_compiles(what: str, how_long: str) -> None:
    log.info("compiling %s for this machine, about %s, once", what, how_long)


def note_compiled(what: str) -> None:
    _stamp(what).touch()


def _stamp(what: str) -> Path:
    target = hashlib.sha256(repr(machine_target()).encode()).hexdigest()[:16]
    return CACHE_FOLDER / f"compiled-{what.replace(' ', '-')}-{target}"
