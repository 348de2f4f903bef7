"""How much main memory this computer has, and how much of it is free. It uses only the standard library."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NamedTuple

CGROUP = Path("/sys/fs/cgroup")
SHARE = "PLGS_MEMORY_GB"
"""The variable by which several engines share this computer: the GB that each may use."""


class MainMemory(NamedTuple):
    """The total and the free bytes. A container's limit, and SHARE, count as the computer's memory."""

    total: int
    free: int


def main_memory(proc: Path = Path("/proc/meminfo"), cgroup: Path = CGROUP) -> MainMemory | None:
    """The current memory; None if the system does not tell. Never raises."""
    try:
        if sys.platform == "win32":
            return _share(_of_windows())
        if proc.exists():
            return _share(_within(_of_linux(proc), cgroup))
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        return _share(MainMemory(total, total))
    except (OSError, ValueError, KeyError, IndexError, OverflowError):
        return None


def _share(memory: MainMemory) -> MainMemory:
    share = int(float(os.environ[SHARE]) * 1e9) if SHARE in os.environ else memory.total
    return MainMemory(min(memory.total, share), min(memory.free, share))


def _of_linux(proc: Path) -> MainMemory:
    """The memory on Linux. Raises OSError, ValueError, KeyError, IndexError."""
    lines = (line.split(":") for line in proc.read_text().splitlines() if ":" in line)
    bytes_of = {name: 1024 * int(value.split()[0]) for name, value in lines}
    return MainMemory(bytes_of["MemTotal"], bytes_of["MemAvailable"])


def _within(memory: MainMemory, cgroup: Path) -> MainMemory:
    """The memory within a container's limit, if there is one."""
    try:
        limit = int((cgroup / "memory.max").read_text())
        held = int((cgroup / "memory.current").read_text()) - _given_back(cgroup)
    except (OSError, ValueError):  # no such file, or "max"
        return memory
    return MainMemory(min(memory.total, limit), min(memory.free, max(0, limit - held)))


def _given_back(cgroup: Path) -> int:
    """Bytes of files that the system keeps in a container's memory until it is needed."""
    try:
        lines = (line.split() for line in (cgroup / "memory.stat").read_text().splitlines())
        return next((int(line[1]) for line in lines if line[:1] == ["inactive_file"]), 0)
    except (OSError, ValueError, IndexError):  # older systems do not tell
        return 0


def _of_windows() -> MainMemory:
    """The memory on Windows. Raises OSError."""
    import ctypes

    class Status(ctypes.Structure):
        """MEMORYSTATUSEX of the Windows API."""

        _fields_ = (
            ("length", ctypes.c_ulong),
            ("load", ctypes.c_ulong),
            *((name, ctypes.c_ulonglong) for name in ("total", "free", "page", "page_free", "own", "own_free", "more")),
        )

    status = Status(length=ctypes.sizeof(Status))
    if not ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):  # type: ignore[attr-defined,unused-ignore]
        raise OSError("GlobalMemoryStatusEx failed")
    return MainMemory(int(status.total), int(status.free))
