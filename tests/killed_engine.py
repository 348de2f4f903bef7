"""Real engines that are killed at a moment of their work, or of which one call to the file system fails. As a script:

killed_engine.py SCENE LIFT
    Lifts SCENE, so that all is loaded and compiled, then forks a real engine for each line of standard input: a JSON
    object, see `run_forked`. Its exit code is a line of standard output. A fork takes the time of the work alone: to
    start a Python with torch takes longer than a tiny lift.
"""

import faulthandler
import gc
import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.faults import CHANGES  # noqa: E402

LONGEST_S = 300.0
"""An engine that takes longer hangs: it ends, and tells where in its output."""


class Moment(NamedTuple):
    """At change number ``change`` (from 1) since stage number ``stage`` began, or, where the stage has fewer, as the
    next one begins; 0 is what comes before the first stage. ``delay_s`` later, if any: then it may be amid a change, or
    amid native code.
    """

    stage: int
    change: int
    delay_s: float = 0.0


class Fault(NamedTuple):
    """Call number ``at`` (from 1; 0: none) for a file below ``below`` fails with ``error``."""

    below: str
    at: int = 0
    error: int = 0


class Changes:
    """Counts an engine's changes to files, whichever thread makes them, and kills it at a moment."""

    def __init__(self, at: Moment | None) -> None:
        self._at, self._stage = at, 0
        self.made = {0: 0}

    def begin(self) -> None:
        """From now on."""
        for name in (*CHANGES, "fdopen"):
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


class Engines:
    """Commands of the real engine, one after another, with one thread each: forks of a process that has all loaded."""

    def __init__(self, scene: Path, folder: Path) -> None:
        one_thread = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")}
        self._counted, self._said = folder / "count", folder / "said"
        self._server = subprocess.Popen(
            [sys.executable, __file__, str(scene), str(folder / "warm")], env=os.environ | one_thread, text=True,
            bufsize=1, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert self._answer() == 0

    def run(self, *arguments: str | Path, at: Moment | None = None, fault: Fault | None = None) -> int:
        """The exit code of an engine that is killed at a moment, or of which a call fails."""
        self._counted.unlink(missing_ok=True)
        asked = {"arguments": [str(part) for part in arguments], "at": at, "fault": fault,
                 "counted": str(self._counted), "said": str(self._said)}  # fmt: skip
        self._server.stdin.write(json.dumps(asked) + "\n")
        return self._answer()

    @property
    def said(self) -> str:
        """What the last engine printed."""
        return self._said.read_text(errors="replace")

    def counted(self) -> Any:
        """The last engine's changes to files in each stage; with a `Fault`, its calls (kind and file) and those that
        failed."""
        return json.loads(self._counted.read_text())

    def close(self) -> None:
        self._server.kill()
        self._server.wait()

    def _answer(self) -> int:
        return int(self._server.stdout.readline())


def serve(scene: Path, lift: Path) -> None:
    """Lift a scene, then run each line of standard input in a fork."""
    import OpenEXR

    import engine.corrections
    import engine.export.mesh
    import engine.export.run  # noqa: F401 - so that forks have it
    from engine.command_line.run_engine import run_engine
    from engine.job import LiftFolder, LiftRequest
    from engine.lift import bake_more
    from engine.lift import run as lifting

    # Every step is a checkpoint, every baked view is kept: so there is more to be torn.
    lifting.CHECKPOINT_EVERY_S = bake_more.KEEP_EVERY_S = -1.0
    lifting.CHECKPOINT_SHARE = float("inf")
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    request = LiftRequest(scene=scene, options={"steps": 2, "warm_start": False})
    answers.write(f"{int(run_engine(LiftFolder.create(lift, request)))}\n")
    OpenEXR.set_global_thread_count(0)  # its threads do not follow into a fork, which would wait for them
    gc.freeze()  # a fork does not copy what its collector would touch
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            run_forked(json.loads(line))
        answers.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")


def run_forked(asked: Mapping[str, Any]) -> None:
    """Run a command; its output goes to the file ``said``, what was counted to ``counted``. Does not return."""
    from engine.command_line.main import main as engine

    output = os.open(asked["said"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    code = 99
    try:
        code = _with_fault(engine, asked) if asked["fault"] else _until_killed(engine, asked)
    except SystemExit as error:
        code = int(error.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _until_killed(engine: Callable[[list[str]], int], asked: Mapping[str, Any]) -> int:
    from engine.job import EventWriter

    changes = Changes(Moment(*asked["at"]) if asked["at"] else None)
    announce = EventWriter.stage

    def stage(self: EventWriter, name: str, index: int, count: int, label: str) -> None:
        changes.begin_stage(index)
        announce(self, name, index, count, label)

    EventWriter.stage = stage  # type: ignore[method-assign]
    changes.begin()
    code = int(engine(asked["arguments"]))
    Path(asked["counted"]).write_text(json.dumps(changes.made))
    return code


def _with_fault(engine: Callable[[list[str]], int], asked: Mapping[str, Any]) -> int:
    import pytest

    from tests.faults import Faults

    fault = Fault(*asked["fault"])
    faults = Faults(Path(fault.below), pytest.MonkeyPatch(), everywhere=True)
    try:
        with faults.failing(fault.at, fault.error, calls=CHANGES):
            return int(engine(asked["arguments"]))
    finally:
        Path(asked["counted"]).write_text(json.dumps([faults.calls, faults.failed]))


if __name__ == "__main__":
    os.fsync = lambda descriptor: None  # a kill loses nothing that was written, synced or not
    serve(Path(sys.argv[1]), Path(sys.argv[2]))
