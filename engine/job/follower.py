"""Follow a lift that an engine works on: a state machine that is polled, for a terminal's loop or Blender's timer."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol
from uuid import uuid4

from ..gates import inner_path
from .detached import DetachedEngine, detached_command
from .errors import JobError, is_silence
from .events import Event, EventReader
from .exit_code import ExitCode
from .folder import BAKE, LIFT, LIVE_PREVIEW, LiftFolder, LiftState
from .json_file import Json
from .log_tail import last_lines
from .process import EngineProcess, engine_call, engine_command, engine_python

LOG_LINES = 40
"""Of the log's end in an outcome: enough for a Python traceback, and for one that a crash in native code leaves."""
_MOST = 1 << 62
"""No count and no number of seconds is larger."""
PATIENCE_S = 5.0
"""So long a folder may be out of reach before its lift counts as lost."""
CANCEL_WAIT_S = 0.65
"""How long an engine may take to stop by itself before it is killed. Its own watchdog needs 0.6 s at most."""


class Engine(Protocol):
    """An engine that this process started: `EngineProcess` or `DetachedEngine`."""

    def exit_code(self) -> int | None: ...
    def output_tail(self) -> str: ...
    def kill(self) -> None: ...
    def close(self) -> None: ...


@dataclass
class LiftStatus:
    """What is known of the run so far. ``task``: "lift" or "bake"; ``stage_index`` counts from 1; ``step`` of ``steps``
    of this stage are done. ``live_preview`` is a picture of the model as it grows, whose content was replaced
    ``live_previews`` times, the last time as seen by the camera with the fingerprint ``live_preview_camera``;
    ``previews`` are the lasting ones."""

    stage: str = ""
    label: str = "Starting"
    stage_index: int = 0
    stage_count: int = 0
    step: int = 0
    steps: int = 0
    loss: float | None = None
    eta_s: float | None = None
    metrics: dict[str, Mapping[str, Json]] = field(default_factory=dict)
    artifacts: list[tuple[str, Path]] = field(default_factory=list)
    previews: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    task: str = LIFT
    live_preview: Path | None = None
    live_previews: int = 0
    live_preview_camera: str = ""


@dataclass(frozen=True)
class Outcome:
    """How it ended. ``error`` is one line for people, None when it finished or was cancelled; ``log_lines`` are the
    log's last, where the error is not the user's."""

    code: ExitCode
    error: str | None = None
    log_lines: tuple[str, ...] = ()


class LiftFollower:
    """Poll it often; between polls it does nothing, and it starts no threads.

    With a process it owns the engine: ``cancel`` ends in a kill if it must, and the engine ends when this Python does
    (unless it was started to go on). Without one it watches an engine that somebody else started, in this machine or
    elsewhere; what earlier runs in the folder told is passed over.
    """

    def __init__(
        self,
        folder: LiftFolder,
        process: Engine | None = None,
        *,
        reader: EventReader | None = None,
        clock: Callable[[], float] = time.monotonic,
        beside: Path | None = None,
    ) -> None:
        """``beside``: the events of an engine of one's own that bakes beside another one; ``reader`` reads them."""
        self.folder, self.status = folder, LiftStatus()
        self._beside = beside
        self._cancel_path = folder.cancel_path if beside is None else beside.with_suffix(".cancel")
        self.outcome: Outcome | None = None
        self._process, self._clock = process, clock
        self._reader = reader or EventReader(folder.events_path, hurried=True)
        self._kill_at: float | None = None
        self._blind_since: float | None = None
        self._error: Event | None = None
        self._done: str | None = None

    @classmethod
    def start(
        cls,
        folder: LiftFolder,
        *,
        resume: bool,
        command: Sequence[str | Path] | None = None,
        stays_with_parent: bool = True,
    ) -> LiftFollower:
        """Start an engine, with its usual command unless told otherwise, and follow it.

        Without ``stays_with_parent`` it goes on when this process ends. Raises JobError when no Python for it is found
        or it does not start.
        """
        command = command or engine_command(engine_python(), folder.path, resume=resume)
        return cls._started(folder, command, stays_with_parent, may_hold_old_cancel=resume)

    @classmethod
    def start_bake(
        cls,
        folder: LiftFolder,
        python: Path,
        frames: Sequence[str] = (),
        *,
        cameras: Path | None = None,
        stays_with_parent: bool = True,
    ) -> LiftFollower:
        """Start an engine that bakes more of a finished lift: frames ("test", "all", or names), or the ``cameras`` of a
        file. Where another process bakes already it does so beside, with events and a cancel file of its own. Otherwise
        as `start`.
        """
        if not folder.is_running:
            command = bake_command(python, folder.path, frames, cameras)
            follower = cls._started(folder, command, stays_with_parent, may_hold_old_cancel=True)
        else:
            events = folder.path / "bake" / f"{uuid4().hex}.jsonl"
            events.parent.mkdir(exist_ok=True)
            command = bake_command(python, folder.path, frames, cameras, events)
            engine = _engine(folder, command, stays_with_parent)
            follower = cls(folder, engine, reader=EventReader(events, hurried=True), beside=events)
        follower.status.task = BAKE
        return follower

    @classmethod
    def _started(
        cls, folder: LiftFolder, command: Sequence[str | Path], stays_with_parent: bool, *, may_hold_old_cancel: bool
    ) -> LiftFollower:
        reader = EventReader(folder.events_path, from_end=True, hurried=True)
        if may_hold_old_cancel:
            # Here, before the engine lives: a cancel that is asked for from now on is not to be taken for an old one.
            folder.cancel_path.unlink(missing_ok=True)
        return cls(folder, _engine(folder, command, stays_with_parent), reader=reader)

    @property
    def is_of_our_own(self) -> bool:
        """Whether this process started the engine."""
        return self._process is not None

    def poll(self) -> list[Event]:
        """The new events; ``status`` and ``outcome`` (None while it goes on) are up to date afterwards.

        Of what happened before the first poll it takes a part at a time, and leaves out progress that is out of date:
        a poll takes a few milliseconds at most. Raises OSError or JobError when the folder could not be looked at for
        some seconds.
        """
        if self.outcome is not None:
            return []
        try:
            events = self._poll()
        except (OSError, JobError) as error:
            if not is_silence(error):
                raise
            # A disk may fail to answer for a moment (EIO, ESTALE): that ends no lift.
            self._blind_since = self._clock() if self._blind_since is None else self._blind_since
            if self._clock() - self._blind_since > PATIENCE_S:
                raise
            return []
        self._blind_since = None
        return events

    def _poll(self) -> list[Event]:
        """Raises OSError or JobError when the folder cannot be looked at."""
        code = self._process.exit_code() if self._process else None
        ended = code is not None if self._process else not self.folder.is_running
        events = self._reader.poll()  # after the look at the process: so the last events are among them
        for event in events:
            self._take(event)
        if ended and not self._reader.is_behind:
            self.outcome = self._outcome(code)
        elif self._process and not ended:
            self._kill_if_deaf()
        return events

    def cancel(self) -> None:
        """Ask the engine to stop; polling goes on until it has.

        Raises OSError when the folder cannot be written and the engine is somebody else's; one's own is killed then.
        """
        try:
            self._cancel_path.touch()
        except OSError:
            if self._process is None:
                raise
        self._begin_waiting()

    def kill(self) -> None:
        """End the engine at once; the lift can be resumed. Only for an engine of one's own."""
        if self._process:
            self._process.kill()

    def close(self) -> None:
        """Let go. An engine of one's own that still runs ends within a second, or goes on if it was started to."""
        if self._process:
            self._process.close()
            self._process = None
        if self._beside is not None and self.outcome is not None:
            for path in (self._beside, self._cancel_path):
                path.unlink(missing_ok=True)

    def _begin_waiting(self) -> None:
        if self._kill_at is None:
            self._kill_at = self._clock() + CANCEL_WAIT_S

    def _kill_if_deaf(self) -> None:
        """Somebody else may have made the cancel file: native code can keep the engine's own watchdog from running."""
        assert self._process is not None
        if self._kill_at is None and (self._cancel_path.exists() or self.folder.cancel_path.exists()):
            self._begin_waiting()
        if self._kill_at is not None and self._clock() >= self._kill_at:
            self._process.kill()

    def _take(self, event: Event) -> None:
        data, status = event.data, self.status
        match event.kind:
            case "hello":
                self.status = LiftStatus(task=str(data.get("task", LIFT)))
                self._error = self._done = None
            case "stage":
                status.stage, status.label = str(data["name"]), str(data["label"])
                status.stage_index, status.stage_count = _int(data["index"]), _int(data["count"])
                status.step, status.steps, status.loss, status.eta_s = 0, 0, None, None
            case "progress":
                status.step, status.steps = _int(data["step"]), _int(data["steps"])
                status.loss, status.eta_s = _float(data.get("loss")), _float(data.get("eta_s"))
            case "metric":
                values = data["values"]
                status.metrics[str(data["name"])] = values if isinstance(values, dict) else {}
            case "artifact" if path := self._inside(data["path"]):
                status.artifacts.append((str(data["kind"]), path))
            case "preview" if data["path"] == LIVE_PREVIEW:
                status.live_preview = self.folder.path / LIVE_PREVIEW
                status.live_previews += 1
                status.live_preview_camera = str(data.get("camera", ""))
            case "preview" if path := self._inside(data["path"]):
                status.previews.append(path)
            case "warning":
                status.warnings.append(str(data["message"]))
            case "error":
                self._error = event
            case "done":
                self._done = str(data["state"])

    def _inside(self, path: Json) -> Path | None:
        """None for a path that leads out of the lift: somebody else may have written the event."""
        try:
            return self.folder.path / inner_path(str(path))
        except ValueError:
            return None

    def _outcome(self, code: int | None) -> Outcome:
        if not self.folder.path.is_dir():  # what the engine said of that is not what happened
            what = f"the lift's folder is gone: {self.folder.path}"
            return Outcome(ExitCode.INTERNAL_ERROR, f"{what}. Bring it back, or lift the scene again.")
        if self._error is not None:
            data = self._error.data
            return self._failed(_exit_code(data.get("exit_code")), f"{data['what']}: {data['where']}. {data['fix']}")
        if code in (ExitCode.BAD_INPUT, ExitCode.INTERNAL_ERROR):  # without an event: it never began
            return self._failed(_exit_code(code), self._last_line())
        state = self.folder.state_at_rest()
        # A bake leaves a finished lift finished, however it ends itself.
        if state is LiftState.FINISHED and (self.status.task == LIFT or self._done == "finished"):
            return Outcome(ExitCode.FINISHED)
        if state is LiftState.CANCELLED or self._done == "cancelled" or self._kill_at is not None:
            return Outcome(ExitCode.CANCELLED)
        if code is not None and code < 0:
            what = f"the engine was ended by signal {-code} (9 often means: out of memory)"
            return self._failed(ExitCode.INTERNAL_ERROR, f"{what}: {self.folder.path}. {self._what_is_left()}")
        return self._failed(_exit_code(code), self._last_line())

    def _failed(self, code: ExitCode, error: str) -> Outcome:
        lines = last_lines(self.folder.log_path, LOG_LINES) if code is ExitCode.INTERNAL_ERROR else ()
        return Outcome(code, error, lines)

    def _last_line(self) -> str:
        """What an engine said last that ended without an event."""
        output = self._process.output_tail() if self._process else ""
        if not output:
            what = "the engine ended without a message (killed, or out of memory?)"
            return f"{what}: {self.folder.log_path}. The log may tell more. {self._what_is_left()}"
        return output.splitlines()[-1].removeprefix("error: ")

    def _what_is_left(self) -> str:
        return "The lift can be resumed." if self.status.task == LIFT else "The result is whole; bake again."


def bake_command(
    python: Path, lift: Path, frames: Sequence[str] = (), cameras: Path | None = None, events: Path | None = None
) -> list[str | Path]:
    """The command that bakes frames of a finished lift, or the cameras of a file, and stays with its parent."""
    command = [*engine_call(python), "bake", lift, "--stay-with-parent"]
    for option, values in (("--cameras", [cameras]), ("--events", [events]), ("--frames", frames)):
        given = [value for value in values if value is not None]
        command += [option, *given] if given else []
    return command


def _engine(folder: LiftFolder, command: Sequence[str | Path], stays_with_parent: bool) -> Engine:
    if stays_with_parent:
        return EngineProcess(command)
    return DetachedEngine(detached_command(command), folder.log_path)


def _int(value: Json) -> int:
    """0 for what counts nothing."""
    return value if isinstance(value, int) and 0 <= value <= _MOST else 0


def _float(value: Json) -> float | None:
    """None for what is no number that could be meant: NaN, infinite, or beyond all bounds."""
    if not isinstance(value, int | float) or not -_MOST <= value <= _MOST:
        return None
    return float(value)


def _exit_code(value: Json) -> ExitCode:
    """The engine's own code, or INTERNAL_ERROR for one that means nothing, or nothing bad, here."""
    if isinstance(value, int) and value in (ExitCode.BAD_INPUT, ExitCode.CANCELLED):
        return ExitCode(value)
    return ExitCode.INTERNAL_ERROR
