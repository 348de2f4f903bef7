"""What the exit status of the engine and of run_plgs.py means."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """130 is the shell's own number for a process ended by Ctrl-C, 143 by SIGTERM."""

    FINISHED = 0
    INTERNAL_ERROR = 1
    BAD_INPUT = 2
    CANCELLED = 3
    INTERRUPTED = 130
    TERMINATED = 143
