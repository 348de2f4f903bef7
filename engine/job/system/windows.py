"""Windows: the same functions as in `posix`."""

from __future__ import annotations

import importlib
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

OPEN_FILES_KEEP_NAMES = True
"""Whether an open file can be neither deleted nor renamed."""
LOCKED_BYTE = 2**30
"""Others cannot read a locked range, so the locked byte is beyond the size that any log reaches."""
_NEW_GROUP, _NO_WINDOW = 0x200, 0x8000000
"""CREATE_NEW_PROCESS_GROUP and CREATE_NO_WINDOW, which `subprocess` has on Windows only."""


def try_lock(descriptor: int, shared: bool = False) -> bool:
    """Try to lock the open file, and return whether it is locked. All locks are exclusive here. Raises OSError if the
    file system does not support locks."""
    msvcrt: Any = importlib.import_module("msvcrt")
    os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError):
        return False
    return True


def flush_folder(path: Path) -> None:
    """Do nothing: folders cannot be opened, and NTFS itself journals names."""


def start_options(keep_open: Sequence[int] = ()) -> dict[str, Any]:
    """Options of `Popen` for a program in its own group, without a window. Descriptors cannot be kept open."""
    return {"creationflags": _NEW_GROUP | _NO_WINDOW}


def kill_with_children(process: subprocess.Popen[bytes]) -> None:
    """End a process and everything that it started, at once. A child that outlived its parent is not found."""
    tree = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
    try:
        subprocess.run(tree, stdin=subprocess.DEVNULL, capture_output=True, creationflags=_NO_WINDOW, timeout=10)
    except (OSError, subprocess.TimeoutExpired):  # on a Windows without taskkill, at least the process itself ends
        pass
    process.kill()


def usable_cpus() -> int:
    """The number of CPUs of this computer."""
    return os.cpu_count() or 1


def peak_bytes() -> int | None:
    """None, as this is not measured here."""
    return None
