"""Both systems' calls behind one interface; Windows' are pretended elsewhere."""

from __future__ import annotations

import errno
import inspect
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from engine.job import lock, system
from engine.job.system import posix, windows


def functions(module: Any) -> dict[str, list[str]]:
    return {
        name: list(inspect.signature(function).parameters)
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__
    }


def test_the_twins_have_the_same_functions() -> None:
    assert functions(posix) == functions(windows)
    assert {*functions(posix), "OPEN_FILES_KEEP_NAMES"} == set(system.__all__)


@pytest.fixture
def ranges(monkeypatch: pytest.MonkeyPatch) -> set[tuple[int, int]]:
    """Windows' byte ranges: (inode, position) of what is locked. Closing does not free them here."""
    locked: set[tuple[int, int]] = set()

    def locking(descriptor: int, mode: int, count: int) -> None:
        assert (mode, count) == (2, 1)
        key = (os.fstat(descriptor).st_ino, os.lseek(descriptor, 0, os.SEEK_CUR))
        if key in locked:
            raise PermissionError(errno.EACCES, "locked")
        locked.add(key)

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    return locked


def test_windows_locks_a_byte_far_behind_the_content(ranges: set[tuple[int, int]], tmp_path: Path) -> None:
    path = tmp_path / "a.lock"
    with path.open("a+b") as first, path.open("a+b") as second:
        assert windows.try_lock(first.fileno())
        assert not windows.try_lock(second.fileno())
        assert not windows.try_lock(second.fileno(), shared=True)
    assert ranges == {(path.stat().st_ino, windows.LOCKED_BYTE)} and path.stat().st_size == 0


def test_a_file_lock_by_windows_calls(
    ranges: set[tuple[int, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "try_lock", windows.try_lock)
    monkeypatch.setattr(lock, "OPEN_FILES_KEEP_NAMES", True)
    path = tmp_path / "a.lock"
    with lock.FileLock(path):
        assert lock.is_locked(path)
    ranges.clear()  # as Windows does when the file is closed
    assert not lock.is_locked(path)


def test_a_disk_without_locks_is_not_taken_for_a_locked_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, mode: int, count: int) -> None:
        raise OSError(errno.EINVAL, "no locks")

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=refuse, LK_NBLCK=2))
    with (tmp_path / "a").open("a+b") as file, pytest.raises(OSError, match="no locks"):
        windows.try_lock(file.fileno())


@pytest.mark.parametrize("fails", [None, FileNotFoundError("taskkill")])
def test_windows_ends_the_children_too(fails: OSError | None, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def run(command: list[str], **options: Any) -> None:
        calls.append(command)
        if fails is not None:
            raise fails

    monkeypatch.setattr(subprocess, "run", run)
    process: Any = SimpleNamespace(pid=7, kill=lambda: calls.append("kill"))
    windows.kill_with_children(process)
    assert calls == [["taskkill", "/F", "/T", "/PID", "7"], "kill"]


def test_windows_programs_have_a_group_and_no_window() -> None:
    assert windows.start_options([3]) == {"creationflags": 0x08000200}


@pytest.mark.parametrize("flush", [system.flush_folder, windows.flush_folder])
def test_a_folder_is_flushed(flush: Callable[[Path], None], tmp_path: Path) -> None:
    flush(tmp_path)
    assert windows.peak_bytes() is None and windows.usable_cpus() >= system.usable_cpus() >= 1


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX")
def test_posix_knows_its_most_memory() -> None:
    most = posix.peak_bytes()
    assert most is not None and most > 1_000_000
