"""An engine that goes on when the process that started it ends: for lifts that outlive Blender."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from .errors import JobError
from .log_tail import last_lines
from .process import ROOT, clean_environment


class DetachedEngine:
    """A started engine that nothing ties to this process: no pipe, a session of its own, output to the lift's log.

    While this process lives it can be asked and killed like an `EngineProcess`. Whoever comes later watches the folder.
    """

    def __init__(self, command: Sequence[str | Path], log: Path, root: Path = ROOT) -> None:
        """Start ``command``. Raises JobError when it cannot be started, or ``log`` cannot be written."""
        self._log = log
        flags: int = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0) | getattr(subprocess, "CREATE_NO_WINDOW", 0)
        try:
            output = log.open("ab")
        except OSError as error:
            raise JobError(f"cannot be written ({error.strerror})", log, "See that the disk has room.") from error
        with output:
            try:
                self._process = subprocess.Popen(
                    [str(part) for part in command],
                    cwd=root,
                    env=clean_environment(root),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    start_new_session=True,  # so the terminal's or Blender's end is not its own
                    creationflags=flags,
                )
            except OSError as error:
                raise JobError(f"cannot be run ({error.strerror})", command[0], "It has to be a Python.") from error

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        return self._process.poll()

    def words(self) -> str:
        """The last line of its log: why it could not begin, when it could not."""
        return "".join(last_lines(self._log, 1))

    def kill(self) -> None:
        """End it and its children at once. Nothing happens when it is over already. Returns when it has ended."""
        if self._process.poll() is None:
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """Let go of it; it goes on."""


def detached_command(command: Sequence[str | Path]) -> list[str | Path]:
    """The command of `engine_command` for an engine that does not stay with its parent."""
    return [part for part in command if part != "--stay-with-parent"]
