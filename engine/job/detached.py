"""An engine that goes on when the process that started it ends: for lifts that outlive Blender."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ..gates import open_to_append
from .errors import JobError
from .log_tail import last_lines
from .process import ROOT, ChildProcess, clean_environment


class DetachedEngine(ChildProcess):
    """A started engine that nothing ties to this process: no pipe, a session of its own, output to the lift's log.

    While this process lives it can be asked and killed like an `EngineProcess`. Whoever comes later watches the folder.
    """

    def __init__(self, command: Sequence[str | Path], log: Path, root: Path = ROOT) -> None:
        """Start ``command``. Raises JobError when it cannot be started, or ``log`` cannot be written."""
        self._log = log
        try:
            output = os.fdopen(open_to_append(log), "ab")
        except OSError as error:
            raise JobError(f"cannot be written ({error.strerror})", log, "See that the disk has room.") from error
        with output:
            super().__init__(command, cwd=root, environment=clean_environment(root), output=output)

    def output_tail(self) -> str:
        """The last line of its log: why it could not begin, when it could not."""
        return "".join(last_lines(self._log, 1))

    def close(self) -> None:
        """Let go of it; it goes on."""


def detached_command(command: Sequence[str | Path]) -> list[str | Path]:
    """The command of `engine_command` for an engine that does not stay with its parent."""
    return [part for part in command if part != "--stay-with-parent"]
