"""Engines that are killed at a moment of their work. Run as a script:

killed_engine.py SCENE LIFT
    Lifts SCENE, so that all is loaded and compiled, then forks a real engine for each line of standard input: a JSON
    object with its ``arguments``, the `Moment` ``at`` which it is killed (null: never), and the file ``counted``, to
    which it writes how many changes there were in each stage. Its exit code is a line of standard output. A fork takes
    the time of the work alone: to start a Python with torch takes longer than a tiny lift.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

CHANGES = ("open", "write", "rename", "replace", "link", "unlink", "mkdir", "rmdir", "fsync", "ftruncate", "fdopen")
LONGEST_S = 300.0
"""An engine that takes longer hangs: it ends, and tells where in the lift's log."""


class Moment(NamedTuple):
    """At change number ``change`` (from 1) since stage number ``stage`` began, or, where the stage has fewer, as the
    next one begins; 0 is what comes before the first stage. ``delay_s`` later, if any: then it may be amid a change, or
    amid native code.
    """

    stage: int
    change: int
    delay_s: float = 0.0


class Changes:
    """Counts an engine's changes to files, whichever thread makes them, and kills it at a moment."""

    def __init__(self, at: Moment | None) -> None:
        self._at, self._stage = at, 0
        self.made = {0: 0}

    def begin(self) -> None:
        """From now on."""
        for name in CHANGES:
            setattr(os, name, self._counted(getattr(os, name)))

    def begin_stage(self, number: int) -> None:
        self._stage = number
        self.made[number] = 0

    def _counted(self, change: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **options: Any) -> Any:
            self.made[self._stage] += 1
            if self._at is not None and (self._stage, self.made[self._stage]) >= self._at[:2]:
                self._kill(self._at.delay_s)
                self._at = None
            return change(*args, **options)

        return counted

    def _kill(self, delay_s: float) -> None:
        if not delay_s:
            os.kill(os.getpid(), signal.SIGKILL)
        signal.setitimer(signal.ITIMER_REAL, delay_s)  # nobody handles its signal: the kernel ends the process at once


def serve(scene: Path, lift: Path, run: Callable[[Mapping[str, Any]], None]) -> None:
    """Lift a scene, then ``run`` each line of standard input in a fork, which it ends."""
    import OpenEXR

    from engine.command_line.run_engine import run_engine
    from engine.job import LiftFolder, LiftRequest
    from engine.lift import bake_more
    from engine.lift import run as lifting

    # Every step is a checkpoint, every baked view is kept: so there is more to be torn.
    lifting.CHECKPOINT_EVERY_S = bake_more.KEEP_EVERY_S = -1.0
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    request = LiftRequest(scene=scene, options={"steps": 2, "warm_start": False})
    answers.write(f"{int(run_engine(LiftFolder.create(lift, request)))}\n")
    OpenEXR.set_global_thread_count(0)  # its threads do not follow into a fork, which would wait for them
    gc.freeze()  # a fork does not copy what its collector would touch
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            run(json.loads(line))
        answers.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")


def run_forked(asked: Mapping[str, Any]) -> None:
    """Does not return."""
    from engine.command_line.main import main as engine
    from engine.job import EventWriter

    changes = Changes(Moment(*asked["at"]) if asked["at"] else None)
    announce = EventWriter.stage

    def stage(self: EventWriter, name: str, index: int, count: int, label: str) -> None:
        changes.begin_stage(index)
        announce(self, name, index, count, label)

    EventWriter.stage = stage  # type: ignore[method-assign]
    code = 99
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    try:
        changes.begin()
        code = int(engine(asked["arguments"]))
        Path(asked["counted"]).write_text(json.dumps(changes.made))
    finally:
        os._exit(code)


if __name__ == "__main__":
    os.fsync = lambda descriptor: None  # a kill loses nothing that was written, synced or not
    serve(Path(sys.argv[1]), Path(sys.argv[2]), run_forked)
