"""An advisory lock of the operating system: it ends with the process that holds it, however that ends."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from types import TracebackType

from ..gates import open_plain, open_to_append
from .errors import JobError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_BYTE = 2**30
"""Windows locks a byte range and forbids reading it, so the locked byte lies where no log ever grows to."""


class FileLock:
    """Exclusive lock on a file, held from ``with`` to its end. A missing file is made; content is untouched.

    Children that are started with ``subprocess`` do not inherit it. Raises JobError when another process
    holds it, or when the file system knows no locks; OSError when it cannot be opened, or is no plain file.
    """

    def __init__(self, path: Path, wait_s: float = 1.0) -> None:
        self._path, self._wait_s, self._descriptor = path, wait_s, -1

    def __enter__(self) -> FileLock:
        self._descriptor = open_to_append(self._path)
        # Somebody who asks `is_locked` holds the lock for an instant: so one refusal proves nothing.
        give_up = time.monotonic() + self._wait_s
        while not self._try():
            if time.monotonic() > give_up:
                os.close(self._descriptor)
                fix = "Wait until it is done, or stop it by making a file named 'cancel' there."
                raise JobError("another engine is at work here", self._path.parent, fix)
            time.sleep(0.05)
        return self

    def _try(self) -> bool:
        """Whether the lock is held now, on the file that has this name: another may have deleted it meanwhile. Where
        that fails the file is closed.
        """
        try:
            if not _try_lock(self._descriptor, self._path):
                return False
            if os.name == "nt" or _is_same(self._descriptor, self._path):  # there no open file can be deleted
                return True
            os.close(self._descriptor)
        except BaseException:
            os.close(self._descriptor)
            raise
        self._descriptor = open_to_append(self._path)
        return False

    @property
    def descriptor(self) -> int:
        """Of the locked file. A POSIX child that inherits it holds the lock too, until it ends."""
        return self._descriptor

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._descriptor)  # closing releases it, on every system


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def is_locked(path: Path) -> bool:
    """Whether a process holds a FileLock on the file. Raises JobError when that cannot be told: the file system
    knows no locks, or a folder has the file's name.
    """
    try:
        # To read is enough for a shared lock: it may be somebody else's lift.
        file = open_plain(path, follow_link=False)
    except FileNotFoundError:
        return False
    except OSError as error:
        fix = "It has to be a file that you may read."
        raise JobError(f"cannot be opened ({error.strerror})", path, fix) from error
    with file:
        return not _try_lock(file.fileno(), path, shared=True)


def _try_lock(descriptor: int, path: Path, shared: bool = False) -> bool:
    try:
        if sys.platform == "win32":
            os.lseek(descriptor, _BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        fix = "Put the lift on a local disk."
        raise JobError(f"its file system cannot lock files ({error.strerror})", path, fix) from error
    return True
