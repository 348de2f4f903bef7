"""An engine that kills itself with SIGKILL at its n-th change to the files of a lift. Run as a script:

killed_engine.py N COUNT fake LIFT     the pretended lift of tests/job/fake_engine.py
killed_engine.py N COUNT ARGUMENTS..   python -m engine ARGUMENTS..

N 0: never. To the file COUNT it writes how many changes there were, when it gets to its end.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

CHANGES = ("open", "write", "rename", "replace", "link", "unlink", "mkdir", "rmdir", "fsync", "ftruncate", "fdopen")
made = 0


def count(at: int) -> None:
    """Let every change count, whichever thread makes it; the one number ``at`` is never made."""

    def counted(change: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **options: Any) -> Any:
            global made
            made += 1
            if made == at:
                os.kill(os.getpid(), signal.SIGKILL)
            return change(*args, **options)

        return wrapped

    for name in CHANGES:
        setattr(os, name, counted(getattr(os, name)))


def main(arguments: list[str]) -> int:
    at, told, *command = arguments
    if command[0] == "fake":
        from engine.command_line.run_engine import run_engine
        from engine.job import LiftFolder
        from tests.job.fake_engine import Pretence

        lift = LiftFolder.open(Path(command[1]))
        os.fsync = lambda descriptor: None
        count(int(at))
        code = int(run_engine(lift, resume=True, lift=Pretence("short, at once")))
    else:
        from engine.command_line.main import main as engine

        count(int(at))
        code = int(engine(command))
    Path(told).write_text(str(made))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
