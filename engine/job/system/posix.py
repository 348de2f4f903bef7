"""Linux and macOS. Modules that Windows lacks are imported where they are needed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

OPEN_FILES_KEEP_NAMES = False
"""Whether an open file can be neither deleted nor renamed."""


def try_lock(descriptor: int, shared: bool = False) -> bool:
    """Try to lock the open file, for this process alone or ``shared`` with others, and return whether it is locked.

    Raises OSError if the file system does not support locks.
    """
    import fcntl

    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def flush_folder(path: Path) -> None:
    """Wait until a folder's list of names would survive a power cut. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def start_options(keep_open: Sequence[int] = ()) -> dict[str, Any]:
    """Options of `Popen` for a program in its own group: Ctrl-C in the terminal reaches only its parent, which then
    asks it to stop. Descriptors in ``keep_open`` stay open in it."""
    return {"start_new_session": True, "pass_fds": tuple(keep_open)}


def kill_with_children(process: subprocess.Popen[bytes]) -> None:
    """End a process that was started with `start_options`, and everything that it started, at once."""
    os.killpg(process.pid, signal.SIGKILL)


def usable_cpus() -> int:
    """The number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_bytes() -> int | None:
    """The most bytes of memory that this process has held; None if the system does not tell."""
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
