"""Log that kernels are being compiled: once on each machine this takes a while, and nothing else shows it."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from functools import cache

from .compiled import CACHE_FOLDER, machine_target

log = logging.getLogger("plgs.machine")


def log_compilation(what: str, how_long: str) -> Callable[[], None]:
    """Log, the first time only, that ``what`` is compiled and ``how_long`` it takes. Call the result when done."""
    # An empty file beside the machine code records that it was compiled.
    stamp = CACHE_FOLDER / f"compiled-{what.replace(' ', '-')}-{_target()}"
    if stamp.exists():
        return lambda: None
    log.info("compiling %s for this machine, about %s, once", what, how_long)
    return stamp.touch


@cache
def _target() -> str:
    return hashlib.sha256(repr(machine_target()).encode()).hexdigest()[:16]
