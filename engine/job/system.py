"""Whatever differs between POSIX and Windows: locks, processes, folders on disk, memory. Modules that only one of them
has are imported where they are needed."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ErrorCode, PlgsError

WINDOWS = os.name == "nt"
OPEN_FILES_KEEP_NAMES = WINDOWS
"""Whether an open file can be neither deleted nor renamed."""
LOCKED_BYTE = 2**30
"""On Windows others cannot read a locked range, so the locked byte is beyond the size that any log reaches."""
LEAST_MEMORY = 2_000_000_000
"""Bytes of address space that the engine needs."""
_NEW_GROUP, _NO_WINDOW = 0x200, 0x8000000
"""CREATE_NEW_PROCESS_GROUP and CREATE_NO_WINDOW, which `subprocess` has on Windows only."""


def try_lock(descriptor: int, shared: bool = False) -> bool:
    """Try to lock the file open as ``descriptor``, alone or ``shared`` with others, and return whether it is locked. On
    Windows all locks are exclusive. Raises OSError if the file system does not support locks."""
    try:
        if WINDOWS:
            msvcrt: Any = importlib.import_module("msvcrt")
            os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)  # msvcrt locks from the current position on
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            fcntl: Any = importlib.import_module("fcntl")
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):  # held by another: what flock and msvcrt raise
        return False
    return True


def flush_folder(path: Path) -> None:
    """Flush a folder's list of names to the disk, to survive a power cut; NTFS does so itself. Raises OSError."""
    if WINDOWS:
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def start_options(keep_open: Sequence[int] = ()) -> dict[str, Any]:
    """Return options of `Popen` for a program in its own process group, without a window: Ctrl-C in the terminal
    reaches only the parent, which then stops the program. Descriptors in ``keep_open`` stay open, not on Windows."""
    if WINDOWS:
        return {"creationflags": _NEW_GROUP | _NO_WINDOW}
    return {"start_new_session": True, "pass_fds": tuple(keep_open)}


def kill_with_children(process: subprocess.Popen[bytes]) -> None:
    """Kill a process that was started with `start_options`, and its children. On Windows, grandchildren survive if
    their own parent has already ended."""
    if not WINDOWS:
        os.killpg(process.pid, signal.SIGKILL)  # as `start_new_session` made it the leader of its group
        return
    tree = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
    try:
        subprocess.run(tree, stdin=subprocess.DEVNULL, capture_output=True, creationflags=_NO_WINDOW, timeout=10)
    except (OSError, subprocess.TimeoutExpired):  # on a Windows without taskkill, at least the process itself ends
        pass
    process.kill()


def refuse_small_memory() -> None:
    """Raise PlgsError for a limit of the address space (ulimit -v) with which OpenBLAS and torch fail, or hang."""
    if WINDOWS:
        return
    resource: Any = importlib.import_module("resource")
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < LEAST_MEMORY:  # -1: no limit
        what = f"the memory limit (ulimit -v) is {limit / 1e9:.1f} GB, too small for the engine"
        fix = f"Raise it to at least {LEAST_MEMORY / 1e9:.0f} GB."
        raise PlgsError("memory-limit", what, "", fix, code=ErrorCode.NO_MEMORY)


def usable_cpus() -> int:
    """The number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_bytes() -> int | None:
    """Return the peak memory of this process in bytes; None on Windows, where it is not measured."""
    if WINDOWS:
        return None
    resource: Any = importlib.import_module("resource")
    most: int = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most  # macOS counts bytes, Linux KiB


CGROUP = Path("/sys/fs/cgroup")
SHARE = "PLGS_MEMORY_GB"
"""The variable by which several engines share this computer: the GB that each may use."""


class MainMemory(NamedTuple):
    """The total and free memory in bytes, within the limits of a container, a farm's job and the variable SHARE."""

    total: int
    free: int


def main_memory(proc: Path = Path("/proc"), cgroup: Path = CGROUP) -> MainMemory | None:
    """Return the memory now; None if the system does not report it. Never raises."""
    try:
        if sys.platform == "win32":
            return _share(_of_windows())
        if (proc / "meminfo").exists():
            lines = (line.split(":") for line in (proc / "meminfo").read_text().splitlines() if ":" in line)
            bytes_of = {name: 1024 * int(value.split()[0]) for name, value in lines}
            memory = MainMemory(bytes_of["MemTotal"], bytes_of["MemAvailable"])
            for group in _groups(proc / "self/cgroup", cgroup):
                memory = _within(memory, group)
            return _share(memory)
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        return _share(MainMemory(total, total))
    except (OSError, ValueError, KeyError, IndexError, OverflowError):
        return None


def _share(memory: MainMemory) -> MainMemory:
    share = int(float(os.environ[SHARE]) * 1e9) if SHARE in os.environ else memory.total
    return MainMemory(min(memory.total, share), min(memory.free, share))


def _groups(own: Path, cgroup: Path) -> list[Path]:
    """Return the cgroups whose limits apply to this process: its own, which Slurm and systemd make for a job, and all
    that contain it. In version 1 of cgroups, those of memory are in a folder of their own."""
    try:
        lines = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        return [cgroup]
    tops = {"": cgroup, "memory": cgroup / "memory"}
    named = [(tops[kind], path) for _, kinds, path in lines for kind in kinds.split(",") if kind in tops]
    return [each for top, path in named for each in (top / path.lstrip("/"), *(top / path.lstrip("/")).parents)
            if each.is_relative_to(top)]  # fmt: skip


def _within(memory: MainMemory, group: Path) -> MainMemory:
    """Return the memory, reduced to a cgroup's limit if it has one."""
    for limit_in, held_in, cached in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # version 1
    ):
        with suppress(OSError, ValueError):  # no such file, or "max"
            limit = int((group / limit_in).read_text())
            held = int((group / held_in).read_text()) - _given_back(group / "memory.stat", cached)
            memory = MainMemory(min(memory.total, limit), min(memory.free, max(0, limit - held)))
    return memory


def _given_back(stat: Path, cached: str) -> int:
    """Return how many bytes of a cgroup's memory are cached files, which the system frees when memory is needed."""
    try:
        lines = (line.split() for line in stat.read_text().splitlines())
        return next((int(line[1]) for line in lines if line[:1] == [cached]), 0)
    except (OSError, ValueError, IndexError):  # older systems do not tell
        return 0


def _of_windows() -> MainMemory:
    """Return the memory on Windows. Raises OSError."""
    import ctypes

    class Status(ctypes.Structure):
        _fields_ = (
            ("length", ctypes.c_ulong),
            ("load", ctypes.c_ulong),
            *((name, ctypes.c_ulonglong) for name in ("total", "free", "page", "page_free", "own", "own_free", "more")),
        )

    status = Status(length=ctypes.sizeof(Status))
    if not ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):  # type: ignore[attr-defined,unused-ignore]
        raise OSError("GlobalMemoryStatusEx failed")
    return MainMemory(int(status.total), int(status.free))
