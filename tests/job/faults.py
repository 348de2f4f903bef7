"""A file system that fails, as SQLite tests with: the n-th call fails, once or from then on, then all heals."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ERRORS = (errno.ENOSPC, errno.EIO, errno.ESTALE, errno.EROFS)
SHORT = 0
"""In place of an error: a write that takes half of what it was given, and then finds the disk full."""
CALLS = ("open", "write", "fsync", "replace", "rename", "link", "unlink", "mkdir", "rmdir", "stat", "lstat", "fstat",
         "ftruncate", "scandir", "listdir")  # fmt: skip
Call = Callable[..., Any]


class Faults:
    """Counts what reaches the file system below ``folder`` in this thread, inside `failing`."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.calls = 0
        self.failed: list[str] = []
        """What failed, as "fsync manifest.json"."""
        self._folder, self._patch, self._thread = str(folder), patch, threading.get_ident()
        self._at, self._error, self._for_good = 0, SHORT, False
        self._is_asleep = False

    @contextmanager
    def failing(self, at: int, error: int, for_good: bool) -> Iterator[None]:
        """Let the call number ``at`` (from 1) fail with ``error``, and with ``for_good`` all that follow."""
        self.calls, self._at, self._error, self._for_good, self.failed = 0, at, error, for_good, []
        with self._patch.context() as patch:
            for name in CALLS:
                patch.setattr(os, name, self._wrapped(name, getattr(os, name)))
            patch.setattr(fcntl, "flock", self._wrapped("lock", fcntl.flock))
            opening, reopening = io.open, os.fdopen
            patch.setattr(io, "open", lambda file, *rest, **more: self._file(opening, file, *rest, **more))
            patch.setattr(os, "fdopen", lambda file, *rest, **more: self._file(reopening, file, *rest, **more))
            yield

    @contextmanager
    def asleep(self) -> Iterator[None]:
        """What happens inside is another process's doing: it neither counts nor fails."""
        self._is_asleep = True
        try:
            yield
        finally:
            self._is_asleep = False

    @property
    def has_failed(self) -> bool:
        return bool(self.failed)

    def tick(self, call: str, where: Any) -> None:
        """Raises OSError when it is this call's turn to fail."""
        path = self._path(where)
        if path is None or self._is_asleep or threading.get_ident() != self._thread:
            return
        self.calls += 1
        if self.calls == self._at or (self._for_good and self.calls > self._at):
            self.failed.append(f"{call} {os.path.basename(path)}")
            number = self._error or errno.ENOSPC
            raise OSError(number, os.strerror(number), path)

    def is_next_short(self) -> bool:
        return self._error == SHORT and self.calls + 1 == self._at

    def _path(self, where: Any) -> str | None:
        """Of a path or descriptor below the folder; None elsewhere."""
        if isinstance(where, int):
            try:
                where = os.readlink(f"/proc/self/fd/{where}")
            except OSError:
                return None
        path = os.fspath(where)
        return path if isinstance(path, str) and path.startswith(self._folder) else None

    def _wrapped(self, name: str, call: Call) -> Call:
        def wrapped(*args: Any, **options: Any) -> Any:
            if name == "write" and self.is_next_short() and len(args[1]) > 1 and self._path(args[0]):
                self.calls += 1
                self._at += 1  # the rest finds no room
                return call(args[0], args[1][: len(args[1]) // 2])
            if name == "fsync":
                return self.tick(name, args[0])  # nobody waits for the disk here
            if args and not options.get("dir_fd"):
                self.tick(name, args[0])
            return call(*args, **options)

        return wrapped

    def _file(self, opening: Call, file: Any, mode: str = "r", *rest: Any, **options: Any) -> Any:
        """A Python file: its writes go through `os.write`, so that they can fail."""
        if not isinstance(file, int):
            self.tick("open", file)
        if "r" in mode or self._path(file) is None:
            return opening(file, mode, *rest, **options)
        raw = io.BufferedWriter(_Raw(file, mode.replace("t", "").replace("b", "")))
        return raw if "b" in mode else io.TextIOWrapper(raw, options.get("encoding"), write_through=True)


class _Raw(io.FileIO):
    def write(self, data: Any) -> int:
        return os.write(self.fileno(), bytes(data))


def every_fault(faults: Faults, thoroughly: bool) -> Iterator[tuple[int, int, bool]]:
    """``at``, ``error``, ``for_good``, until nothing failed in the caller's last round. Each call fails with one kind
    of error, in turn; ``thoroughly`` with each.
    """
    at, kinds = 0, (*ERRORS, SHORT)
    while at == 0 or faults.has_failed or faults.calls >= at:
        at += 1
        for error in kinds if thoroughly else (kinds[at % len(kinds)],):
            yield at, error, False
            yield at, error, True
