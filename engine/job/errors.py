"""The two ways a lift ends early that are no defect of the engine."""

from __future__ import annotations

import errno
from pathlib import Path

from ..gates import printable

SILENT = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN, errno.EINTR, errno.ENOMEM)
"""Errors of a disk or share that does not answer now: nothing is said about what lies there."""


class JobError(Exception):
    """A request or lift folder that cannot be used: what is wrong, where, what to do about it (exit code
    2)."""

    def __init__(self, what: str, where: Path | str, fix: str) -> None:
        super().__init__(printable(f"{what}: {where}. {fix}").replace("\n", " "))
        self.what, self.where, self.fix = what, str(where), fix


class Cancelled(Exception):
    """Somebody asked the lift to stop. Nothing is lost: the last checkpoint can be resumed (exit code 3)."""
