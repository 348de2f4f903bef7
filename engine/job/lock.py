"""Advisory locks of the operating system: they end with the process that holds them, however it ends. A disk that
several machines share must lock for all of them, as NFS does. Several processes may bake one lift at once. Their locks
are empty files in bake/ in the lift folder. They show which processes are at work, which view each one bakes, and which
may change the manifest now."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from uuid import uuid4

from ..errors import ErrorCode, PlgsError
from ..gates import open_plain, open_to_append
from .events import at_work
from .system import OPEN_FILES_KEEP_NAMES, try_lock

MANIFEST_S = 60.0
"""Seconds for which a process waits for its turn at the manifest while others hash what they baked."""


class FileLock:
    """An exclusive lock on a file, held within a ``with`` block. A missing file is created; content is untouched.
    Children that are started with ``subprocess`` do not inherit it. Raises PlgsError if another process holds it, or if
    the file system does not support locks; OSError if it cannot be opened, or is not a plain file."""

    def __init__(self, path: Path, wait_s: float = 1.0) -> None:
        self._path, self._wait_s, self._descriptor = path, wait_s, -1

    def __enter__(self) -> FileLock:
        self._descriptor = open_to_append(self._path)
        # A process that calls `is_locked` holds the lock for an instant, so a single refusal proves nothing.
        give_up = time.monotonic() + self._wait_s
        while not self._try():
            if time.monotonic() > give_up:
                os.close(self._descriptor)
                raise at_work(self._path)
            time.sleep(0.05)
        return self

    def _try(self) -> bool:
        """Try to lock the file that has this name now, as another process may have deleted the opened one. Returns
        whether it is locked; if not, the file is closed."""
        try:
            if not _try_lock(self._descriptor, self._path):
                return False
            with suppress(FileNotFoundError):
                if OPEN_FILES_KEEP_NAMES or os.path.samestat(os.fstat(self._descriptor), os.stat(self._path)):
                    return True
            os.close(self._descriptor)
        except BaseException:
            os.close(self._descriptor)
            raise
        self._descriptor = open_to_append(self._path)
        return False

    @property
    def descriptor(self) -> int:
        """The locked file's descriptor. A POSIX child that inherits it holds the lock too, until it ends."""
        return self._descriptor

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)  # closing releases it, on every system


def is_locked(path: Path) -> bool:
    """Whether a process holds a FileLock on the file. Raises PlgsError if that cannot be determined: the file system
    does not support locks, or a folder has the file's name."""
    try:
        # Reading is enough for a shared lock, and the lift may belong to somebody else.
        file = open_plain(path, follow_link=False)
    except FileNotFoundError:
        return False
    except OSError as error:
        fix = "It must be a file that you can read."
        raise PlgsError("unopenable", f"cannot be opened ({error.strerror})", path, fix) from error
    with file:
        return not _try_lock(file.fileno(), path, shared=True)


def _try_lock(descriptor: int, path: Path, shared: bool = False) -> bool:
    try:
        return try_lock(descriptor, shared)
    except OSError as error:
        fix = "Put the lift on a local disk, or on a shared one with locks: NFS 4, or NFS 3 with lockd."
        raise PlgsError("no-file-locks", f"cannot be locked on its disk ({error.strerror})", path, fix) from error


class BakeLocks:
    """The locks of one process that bakes; use it in a ``with`` statement around all of its work. Raises OSError."""

    def __init__(self, lift: Path) -> None:
        self._folder = lift / "bake"
        self._own = self._folder / f"process-{uuid4().hex}.lock"
        self._held: FileLock | None = None

    def __enter__(self) -> BakeLocks:
        self._folder.mkdir(exist_ok=True)
        self._own.touch()
        self._held = FileLock(self._own).__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        assert self._held is not None
        self._held.__exit__()
        with suppress(OSError):  # on Windows, where another process looks at it now
            self._own.unlink()

    def others_at_work(self) -> bool:
        """Whether another process is baking this lift. Lock files of killed processes are deleted. A process that is
        about to lock such a file creates it again (`FileLock`)."""
        others = [path for path in self._folder.glob("process-*.lock") if path != self._own]
        left_behind = [path for path in others if not is_locked(path)]
        for path in left_behind:
            with suppress(OSError):
                path.unlink()
        return len(left_behind) < len(others)

    @contextmanager
    def claim(self, view: str) -> Iterator[bool]:
        """Yield whether this process may bake the ``view`` within the ``with`` block; False if another is baking it.
        Raises PlgsError if the file system does not support locks."""
        path = self._folder / f"view-{sha256(view.encode()).hexdigest()[:16]}.lock"  # so that any text is a name
        try:
            lock = FileLock(path, wait_s=0.0).__enter__()
        except PlgsError as error:
            if error.code is not ErrorCode.BUSY:
                raise
            yield False
            return
        try:
            yield True
            if not OPEN_FILES_KEEP_NAMES:  # others look whether the file that they locked still has its name
                path.unlink(missing_ok=True)
        finally:
            lock.__exit__()

    def manifest(self) -> FileLock:
        """The lock that a process holds while it changes the manifest; use it in a ``with`` statement."""
        return FileLock(self._folder / "manifest.lock", MANIFEST_S)
