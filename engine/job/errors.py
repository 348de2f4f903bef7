"""The two ways a lift ends early that are no defect of the engine."""

from __future__ import annotations

import errno
from pathlib import Path

from ..gates import printable

_SILENT = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN, errno.EINTR, errno.ENOMEM)


class JobError(Exception):
    """A request or lift folder that cannot be used: what is wrong, where, what to do about it (exit code
    2)."""

    def __init__(self, what: str, where: Path | str, fix: str) -> None:
        super().__init__(printable(f"{what}: {where}. {fix}").replace("\n", " "))
        self.what, self.where, self.fix = what, str(where), fix


class Cancelled(Exception):
    """Somebody asked the lift to stop. Nothing is lost: the last checkpoint can be resumed (exit code 3)."""


def is_silence(error: BaseException | None) -> bool:
    """Whether a disk or share did not answer, which says nothing about what lies there: ``error`` or its cause."""
    causes = (error, error.__cause__ if error is not None else None)
    return any(isinstance(one, OSError) and one.errno in _SILENT for one in causes)
