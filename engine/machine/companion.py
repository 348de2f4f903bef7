"""A second process that compiles while this one does.

Numba compiles on one core, whatever the number of threads. What it has compiled lies in the cache, where another
process finds it: so a second one may take half of the work. Whatever becomes of it, the kernels work: those that are
not in the cache when they are called are compiled then.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from pathlib import Path

log = logging.getLogger("plgs.machine")

PATIENCE = 2.0
"""A companion that takes so many times as long as this process took for its own half is given up."""
LEAST_PATIENCE = 10.0
"""Seconds."""


class Companion:
    """``python -m MODULE``, started at once; it works on its own until ``wait``."""

    def __init__(self, module: str) -> None:
        self._started = time.monotonic()
        self._process: subprocess.Popen[bytes] | None = None
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module],
                env=os.environ | {"PYTHONPATH": _search_path()},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            log.warning("no second process to compile with (%s); compiling alone", error)

    def wait(self) -> None:
        """Until it has ended; one that seems to hang is killed. The log says what went wrong."""
        process, self._process = self._process, None
        if process is None:
            return
        patience = max(LEAST_PATIENCE, (PATIENCE - 1.0) * (time.monotonic() - self._started))
        try:
            said = process.communicate(timeout=patience)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            log.warning("the second process that compiles took too long; compiling alone")
            return
        if process.returncode != 0:
            last_line = (said.decode(errors="replace").strip().splitlines() or ["nothing"])[-1]
            log.warning(
                "the second process that compiles failed (status %d, it said: %s); compiling alone",
                process.returncode,
                last_line,
            )


def has_room_for_two() -> bool:
    """Whether a second process would have a core of its own, and there is an interpreter to start."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    return cores > 1 and bool(sys.executable)


def _search_path() -> str:
    """Where this process found the engine, then where it looks for everything else."""
    levels = __name__.count(".") + 1
    return os.pathsep.join([str(Path(__file__).resolve().parents[levels - 1]), *filter(None, sys.path)])
