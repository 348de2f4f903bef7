"""Follow an engine's task with a state machine that a terminal's loop or Blender's timer polls."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from ..errors import STOPPED, ErrorCode, ExitCode, PlgsError, is_silence
from ..json_file import Json
from .events import Event, EventReader
from .folder import LiftFolder, LiftState
from .lock import is_locked
from .process import EngineProcess, engine_call
from .task import BAKE, LIFT, TaskFiles, TaskProgress, TaskState, last_lines

PATIENCE_S = 5.0
"""Seconds for which a folder may be unreachable before its task counts as lost."""
CANCEL_WAIT_S = 0.65
"""Seconds that an engine may take to stop before it is killed. Its own watchdog needs at most 0.6."""


class TaskFollower:
    """Follows one task: `poll` it often, then read its attributes. It starts no threads. ``kind`` names the task,
    ``progress`` is its progress. When ``state`` is no longer RUNNING, ``answer`` is the command's answer (None if it
    gave none), ``error`` is why it failed, and ``log_lines`` the end of its log if the cause is not the user's input.
    ``on_event`` is called with each event. ``kill_at`` is when the engine is killed, None until asked to stop."""

    def __init__(
        self,
        files: TaskFiles,
        process: EngineProcess | None = None,
        *,
        kind: str = LIFT,
        lift: LiftFolder | None = None,
        reader: EventReader | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Own the engine ``process`` or, without one, watch an engine that another process started, on this computer or
        another. ``lift`` is the lift folder that the task works in; ``reader`` has read its earlier events."""
        self.files, self.lift, self.kind = files, lift, kind
        self.state = TaskState.RUNNING
        self.progress = TaskProgress()
        self.answer: Mapping[str, Json] | None = None
        self.error: PlgsError | None = None
        self.log_lines: tuple[str, ...] = ()
        self.on_event: Callable[[Event], object] | None = None
        self._process, self._clock = process, clock
        self._reader = reader or EventReader(files.events, hurried=True)
        self.kill_at: float | None = None
        self._silent_since: float | None = None
        self._done: str | None = None

    @classmethod
    def start(
        cls,
        command: Sequence[str | Path],
        files: TaskFiles,
        *,
        kind: str,
        lift: LiftFolder | None = None,
        stays_with_parent: bool = True,
        variables: Mapping[str, str] | None = None,
    ) -> TaskFollower:
        """Start an engine and follow it. ``command`` is one from `engine_call`, to which the arguments for ``files``
        and its parent are added. Without ``stays_with_parent`` it continues when this process ends. ``variables`` are
        for its environment: values that must not appear in the list of processes. Raises PlgsError, OSError."""
        reader = EventReader(files.events, from_end=True, hurried=True)  # events of earlier runs are skipped
        if not is_locked(files.events):
            # Before the engine starts: a cancel file that is made from now on is meant for it.
            files.cancel.unlink(missing_ok=True)
        command = [*command, *files.arguments, *(["--stay-with-parent"] if stays_with_parent else [])]
        process = EngineProcess(command, is_tied=stays_with_parent, variables=variables)
        return cls(files, process, kind=kind, lift=lift, reader=reader)

    @property
    def is_running(self) -> bool:
        return self.state is TaskState.RUNNING

    @property
    def is_own(self) -> bool:
        return self._process is not None

    @property
    def pid(self) -> int:
        """The process id of the follower's own engine; 0 if another process started it."""
        return 0 if self._process is None else self._process.pid

    @property
    def exit_code(self) -> ExitCode:
        """The outcome of an ended task, as the exit status of a command that ran it."""
        if self.state is TaskState.CANCELLED:
            return ExitCode.CANCELLED
        return ExitCode.FINISHED if self.error is None else self.error.exit_code

    def poll(self) -> bool:
        """Read what happened, and return whether anything changed. Older events are read in parts, and outdated
        progress is skipped, so that a poll takes at most a few milliseconds."""
        if not self.is_running:
            return False
        try:
            has_news = self._poll()
        except (OSError, PlgsError) as error:
            self._silent_since = self._clock() if self._silent_since is None else self._silent_since
            if is_silence(error) and self._clock() - self._silent_since <= PATIENCE_S:
                return False  # a disk may fail to answer for a moment (EIO, ESTALE)
            if self._process is not None:
                self._process.kill()
            fix = "Check its disk, then try again."
            self._fail(PlgsError("unfollowed", f"the task can no longer be followed ({error})", self.files.events, fix))
            return True
        self._silent_since = None
        return has_news

    def cancel(self) -> None:
        """Ask the engine to stop. Keep polling until it has: it is killed if it takes too long. Raises OSError if the
        cancel file cannot be made and another process started the engine."""
        try:
            self.files.ask_to_cancel()
        except OSError:
            if self._process is None:
                raise
        self._begin_waiting()

    def kill(self) -> None:
        """End the follower's own engine at once; a lift can be resumed."""
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Stop following. The follower's own engine ends within a second, unless it was started to continue alone."""
        if self._process is None:
            return
        self._process.close()
        if self.files.folder is not None and self._process.exit_code() is not None:
            with suppress(OSError):
                self.files.discard()
        self._process = None

    def _poll(self) -> bool:
        """Read the new events once, and see whether the engine runs. Returns whether anything changed. Raises OSError
        or PlgsError if the folder cannot be read."""
        code = None if self._process is None else self._process.exit_code()
        has_ended = not is_locked(self.files.events) if self._process is None else code is not None
        events = self._reader.poll()  # read after the check of the process, so that the last events are included
        for event in events:
            self._take(event)
        if has_ended and not self._reader.is_behind:
            self._end(code)
        elif self._process is not None and not has_ended:
            self._kill_if_deaf(self._process)
        return bool(events) or not self.is_running

    def _take(self, event: Event) -> None:
        data = event.data
        if self.on_event is not None:
            self.on_event(event)
        match event.kind:
            case "hello":
                self.kind, self.progress = str(data.get("task", LIFT)), TaskProgress(began=event.time)
                self.answer = self.error = self._done = None  # a new run in the same file
            case "answer" if isinstance(data["answer"], dict):
                self.answer = data["answer"]
            case "error":
                self.error = _error(data)
            case "done":
                self._done = str(data["state"])
            case _:
                self.progress.take(event, self.files.events.parent)

    def _begin_waiting(self) -> None:
        if self.kill_at is None:
            self.kill_at = self._clock() + CANCEL_WAIT_S

    def _kill_if_deaf(self, process: EngineProcess) -> None:
        """Kill an engine that was asked to stop, by any process, and did not: native code can block its watchdog."""
        is_asked = self.files.cancel.exists() or (self.lift is not None and self.lift.task_files.cancel.exists())
        if is_asked:
            self._begin_waiting()
        if self.kill_at is not None and self._clock() >= self.kill_at:
            process.kill()

    def _end(self, code: int | None) -> None:
        """Note that the task has ended. ``code`` is the engine's exit code; None if another process started it."""
        if not self.files.events.parent.is_dir():  # the folder is gone, which the engine's own error does not say
            fix = "Restore it, or start again."
            where = self.files.events.parent
            self._fail(PlgsError("folder-gone", "the folder was deleted or moved", where, fix, code=ErrorCode.INTERNAL))
        elif self.error is not None:
            self._fail(self.error)
        elif code in (ExitCode.BAD_INPUT, ExitCode.INTERNAL_ERROR, ExitCode.BUSY):  # without an event: it never began
            self._fail(self._error_of_output(code))
        elif (
            self.lift.state_at_rest() is LiftState.FINISHED  # the result decides, whatever the events say
            if self.lift is not None and self.kind == LIFT
            else self._done == "finished" or code == ExitCode.FINISHED
        ):
            self.state = TaskState.FINISHED
        elif self._done == "cancelled" or self.kill_at is not None or code in STOPPED:
            self.state = TaskState.CANCELLED
        elif code is not None and code < 0:
            hint = " (often: out of memory)" if code == -9 else ""  # SIGKILL, which Linux sends then
            what = f"the engine was ended by signal {-code}{hint}"
            self._fail(PlgsError("killed", what, self.files.events.parent, self._what_is_left(), code=ErrorCode.KILLED))
        else:
            self._fail(self._error_of_output(code))

    def _fail(self, error: PlgsError) -> None:
        self.state, self.error = TaskState.FAILED, error
        if error.exit_code is ExitCode.INTERNAL_ERROR:
            self.log_lines = last_lines(self.files.log)

    def _error_of_output(self, code: int | None) -> PlgsError:
        """Return the error of an engine that ended without an event, from the last message in its output."""
        output = "" if self._process is None else self._process.output_tail()
        kinds: dict[int | None, ErrorCode] = {ExitCode.BAD_INPUT: ErrorCode.BAD_INPUT, ExitCode.BUSY: ErrorCode.BUSY}
        kind = kinds.get(code, ErrorCode.INTERNAL)
        if output:
            return PlgsError("engine-said", output.splitlines()[-1].removeprefix("error: "), "", "", code=kind)
        what = "the engine ended without a message (killed, or out of memory?)"
        return PlgsError("no-message", what, self.files.log, f"The log may say more. {self._what_is_left()}", code=kind)

    def _what_is_left(self) -> str:
        return {LIFT: "The lift can be resumed.", BAKE: "The result is whole; bake again."}.get(self.kind, "Try again.")


def start_bake(
    lift: LiftFolder,
    python: Path,
    frames: Sequence[str] = (),
    *,
    cameras: Path | None = None,
    layers: Sequence[str] = (),
    output: Path | None = None,
    channels: str = "",
    replace: bool = False,
    stays_with_parent: bool = True,
) -> TaskFollower:
    """Start an engine that bakes more of a finished lift: frames ("test", "all", or names), or the ``cameras`` in a
    file, with these FURTHER_LAYERS. ``channels`` is one of CHANNELS, and names the channels for another program. With
    ``replace`` it overwrites other programs' files in ``output``. If another process is baking already, both bake, each
    with its own events. Raises PlgsError if it cannot start, OSError."""
    command: list[str | Path] = [*engine_call(python), "bake", lift.path]
    given = {"--cameras": [cameras], "-o": [output], "--frames": frames, "--layers": layers, "--channels": [channels]}
    for option, values in given.items():
        command += [option, *(each for each in values if each)] if any(values) else []
    command += ["--replace"] if replace else []
    files = lift.task_files
    if lift.is_running:
        (lift.path / "bake").mkdir(exist_ok=True)
        files = TaskFiles.temporary(lift.path / "bake")
    return TaskFollower.start(command, files, kind=BAKE, lift=lift, stays_with_parent=stays_with_parent)


def _error(data: Mapping[str, Json]) -> PlgsError:
    """Return the error that an event holds. Codes of later versions may be unknown."""
    said = str(data.get("code"))
    code = ErrorCode(said) if said in list(ErrorCode) else ErrorCode.INTERNAL
    what, where, fix = (str(data[key]) for key in ("what", "where", "fix"))
    key = str(data.get("key") or "engine-said")
    return PlgsError(key, what, where, fix, code=code, option=str(data.get("option") or ""))
