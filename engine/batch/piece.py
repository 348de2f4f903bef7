"""Do one piece of a batch's work on a worker: start an engine, follow it, and end it if the worker ends."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from .. import __version__
from ..errors import ErrorCode, ExitCode, PlgsError
from ..job import LiftFolder, LiftRequest
from ..job.follower import TaskFollower
from ..job.process import ROOT, engine_call, engine_command
from ..job.system import SHARE
from ..job.task import BAKE, LIFT, TaskFiles, TaskProgress
from ..json_file import Json
from ..machine.code_digest import code_digest

POLL_S = 0.1
TELL_S = 1.0
"""Seconds between two progress reports of a piece."""
BUSY_S = 1.0
"""Seconds between two tries while another engine is at work, such as that of a worker that does not answer."""
STALL_S = 300.0
"""Seconds without a report or CPU use after which an engine counts as hung and is killed."""
_WORKER_CODES = (ErrorCode.DISK_FULL, ErrorCode.NO_ENGINE, ErrorCode.LACKS_PART, ErrorCode.NO_MEMORY)
"""Errors that concern the worker rather than the scene."""


class Kind(StrEnum):
    LIFT = "lift"
    BAKE = "bake"
    EXPORT = "export"
    SCORE = "score"


@dataclass(frozen=True)
class Piece:
    """A piece of work on one scene's lift, for workers with the `engine_tag` ``engine``. ``names`` are the frames of a
    BAKE, or the form of an EXPORT. ``tells_frames``: a LIFT answers with its frames. ``is_resumed``: begun before."""

    kind: Kind
    scene: str
    lift: Path
    request: LiftRequest
    engine: str
    names: tuple[str, ...] = ()
    tells_frames: bool = False
    is_resumed: bool = False

    def needs_engine(self) -> list[str | Path]:
        """Return the command that starts the engine for any piece but a lift."""
        call: list[str | Path] = [*engine_call(Path(sys.executable))]
        match self.kind:
            case Kind.BAKE:
                return [*call, "bake", self.lift, "--frames", *self.names]
            case Kind.EXPORT:
                (form,) = self.names
                return [*call, "export", self.lift, "--to", form, "-o", self.lift / "exports" / form]
        return [*call, "evaluate", self.lift]


class Ended(StrEnum):
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    KILLED = "killed"  # a signal ended the engine
    ELSEWHERE = "elsewhere"  # this worker cannot: it lacks the scene, its disk is full, or its engine is different


_ENDS = {ErrorCode.KILLED: Ended.KILLED, **dict.fromkeys(_WORKER_CODES, Ended.ELSEWHERE)}


@dataclass(frozen=True)
class Outcome:
    """How a piece ``ended``, after how many ``seconds``, why (``reason``, ``exit_code``), on which ``worker``, and its
    ``answer`` (for a lift its frames, for a score the metrics). ``lacked_memory``: its engine was killed, perhaps for
    lack of memory."""

    piece: Piece
    ended: Ended
    seconds: float
    reason: str = ""
    exit_code: int = 0
    worker: str = ""
    answer: Mapping[str, Json] = field(default_factory=dict)
    lacked_memory: bool = False


Tell = Callable[[TaskProgress], object]


def engine_tag() -> str:
    """Return a text that identifies this exact engine: its version and its code."""
    return f"plgs-{__version__}-{code_digest('engine')}"


def do(piece: Piece, tell: Tell, threads: int = 0, worker: str = "", gigabytes: float = 0.0) -> Outcome:
    """Do a piece with this many ``threads`` and ``gigabytes`` (0: all), or return at once if it is done already.
    ``tell`` gets its progress. Problems of the scene or the machine are not raised but in the outcome."""
    began, kills = time.monotonic(), memory_kills()
    variables = {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)} if threads else {}
    if gigabytes:
        variables[SHARE] = f"{gigabytes:g}"

    def outcome(ended: Ended, error: PlgsError | None = None, answer: Mapping[str, Json] | None = None) -> Outcome:
        reason, code = ("", 0) if error is None else (str(error), int(error.exit_code))
        code = ExitCode.CANCELLED if ended is Ended.CANCELLED else code
        lacked = ended is Ended.KILLED and (kills is None or memory_kills() != kills)  # None: it is not known
        return Outcome(piece, ended, time.monotonic() - began, reason, code, worker, answer or {}, lacked)

    try:
        _refuse_unfit_worker(piece)
        follower = _followed(piece, tell, variables)
        is_done = follower is None or follower.error is None and follower.exit_code is ExitCode.FINISHED
        frames = list[Json]()
        if piece.tells_frames and is_done:
            from ..scene_of_lift import scene_of_lift  # late: it reads masks

            frames += [frame.name for frame in scene_of_lift(LiftFolder.open(piece.lift)).frames]
    except PlgsError as error:
        return outcome(_ENDS.get(error.code, Ended.FAILED), error)
    except OSError as error:
        what = f"cannot be used ({error.strerror})"
        where = error.filename or piece.lift
        return outcome(Ended.FAILED, PlgsError("piece-unusable", what, where, "Fix this, then start the batch again."))
    if follower is not None and follower.error is not None:
        return outcome(_ENDS.get(follower.error.code, Ended.FAILED), follower.error)
    if follower is not None and follower.exit_code is not ExitCode.FINISHED:
        if follower.kill_at is None and not (piece.lift / "cancel").exists():  # nobody asked it to stop
            what = "the engine was ended by a termination signal"
            fix = "Start the batch again."
            return outcome(Ended.KILLED, PlgsError("killed", what, piece.lift, fix, code=ErrorCode.KILLED))
        return outcome(Ended.CANCELLED)
    if piece.tells_frames:
        return outcome(Ended.DONE, answer={"frames": frames})
    return outcome(Ended.DONE, answer=follower.answer if follower is not None else None)


def memory_kills() -> int | None:
    """Return how many processes Linux has killed here for lack of memory; None where that is not counted."""
    try:
        counts = dict(line.split() for line in Path("/proc/vmstat").read_text().splitlines())
        return int(counts["oom_kill"])
    except (OSError, ValueError, KeyError):
        return None


def _refuse_unfit_worker(piece: Piece) -> None:
    """Raise PlgsError if this worker has another engine or lacks the piece's folders: then another may do it."""
    if engine_tag() != piece.engine:
        fix = f"Start workers with the engine {piece.engine}."
        raise PlgsError("worker-other-engine", f"the worker has {engine_tag()}", ROOT, fix, code=ErrorCode.NO_ENGINE)
    needed = [piece.lift.parent] if piece.kind is Kind.LIFT else [piece.lift]
    if piece.kind is not Kind.BAKE:
        needed.insert(0, piece.request.scene)
    for path in needed:
        if not path.exists():
            fix = "Mount it there under the same path."
            raise PlgsError("not-on-worker", "does not exist on this worker", path, fix, code=ErrorCode.NO_ENGINE)


def _followed(piece: Piece, tell: Tell, variables: Mapping[str, str]) -> TaskFollower | None:
    """Run the piece's engine with these environment ``variables``, and ``tell`` its progress. Returns its follower at
    the end, None if there was nothing to do. If another engine works on the lift, wait for its end first."""
    reported = 0.0
    while True:
        follower = _started(piece, variables)
        if follower is None:
            return None
        try:
            pulse = _Pulse(follower)
            while follower.is_running:
                if follower.poll():
                    pulse.beat()
                if time.monotonic() - reported > TELL_S:
                    pulse.check(piece)
                    reported = time.monotonic()
                    tell(follower.progress)
                time.sleep(POLL_S)
        finally:
            follower.kill()
            follower.close()
        if follower.error is None or follower.error.code is not ErrorCode.BUSY:
            return follower
        time.sleep(BUSY_S)


class _Pulse:
    """Checks whether an engine still runs, as a suspended one would hold up a batch. Only the processor time of its
    watchdog counts, as the engine itself may wait for another one that bakes."""

    def __init__(self, follower: TaskFollower) -> None:
        from psutil import Process  # late: distributed brings it, which only batches have

        self._process = Process(follower.pid)
        self._used = -1.0
        self.beat()

    def beat(self) -> None:
        self._last = time.monotonic()

    def check(self, piece: Piece) -> None:
        """Raise PlgsError with the code KILLED if the engine has done nothing for STALL_S seconds."""
        from psutil import Error

        try:
            used = sum(self._process.cpu_times()[:2])  # user and system seconds
        except Error:  # it has ended
            return
        if used - self._used > 0.01:  # more than one tick of 10 ms, Linux's unit
            self._used = used
            self.beat()
        elif time.monotonic() - self._last > STALL_S:
            minutes = STALL_S / 60
            what = f"the engine was ended, as it had done nothing for {minutes:.0f} minutes (it was suspended)"
            fix = "Start the batch again: it resumes where it stopped."
            raise PlgsError("engine-stalled", what, piece.lift, fix, code=ErrorCode.KILLED)


def _started(piece: Piece, variables: Mapping[str, str]) -> TaskFollower | None:
    if piece.kind is Kind.LIFT:
        from ..scene_of_lift import is_done  # late: it reads masks

        lift = _lift_folder(piece)
        if not lift.is_running and not lift.is_lifted_again and is_done(lift):
            return None
        # Also a new lift: before this engine begins, that of another batch may have begun it, or done it.
        command = engine_command(Path(sys.executable), lift.path, resume=True)
        return TaskFollower.start(command, lift.task_files, kind=LIFT, lift=lift, variables=variables)
    lift = LiftFolder.open(piece.lift)
    kind = BAKE if piece.kind is Kind.BAKE else str(piece.kind)
    return TaskFollower.start(piece.needs_engine(), TaskFiles.temporary(), kind=kind, lift=lift, variables=variables)


def _lift_folder(piece: Piece) -> LiftFolder:
    """Open the piece's lift folder, or create it. Raises PlgsError if it is damaged or was asked for something else."""
    if not (piece.lift / "request.json").exists():
        try:
            return LiftFolder.create(piece.lift, piece.request)
        except PlgsError:
            if not (piece.lift / "request.json").exists():  # otherwise two workers made it at the same time
                raise
    return LiftFolder.open(piece.lift).asked_again(piece.request)


def do_on_dask(piece: Piece) -> Outcome:
    """Run `do` on a Dask worker, and report its progress as events with the topic TOPIC."""
    from distributed import get_worker

    from ..job.terminal import describe

    worker = get_worker()

    def tell(progress: TaskProgress) -> None:
        worker.log_event(TOPIC, {"scene": piece.scene, "kind": str(piece.kind), "text": describe(progress)})

    offers = worker.state.total_resources
    name = f"{os.uname().nodename if hasattr(os, 'uname') else ''} {worker.name}".strip()  # Windows has no uname
    return do(piece, tell, int(offers.get(THREADS, 0)), name, offers.get(GIGABYTES, 0.0))


TOPIC = "plgs-batch"
THREADS, GIGABYTES = "PLGS_THREADS", "PLGS_GB"
"""The resources of a worker: compute threads, and memory in GB."""
