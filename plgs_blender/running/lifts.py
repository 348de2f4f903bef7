"""The lifts that this Blender follows, by folder: started, watched, cancelled, resumed. Knows nothing of Blender.

They live in the module, not in an operator or a file: so they survive undo and the opening of another .blend.
`poll_all` is called often; it never waits, and no thread is used.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...engine.job import ExitCode, JobError, LiftFolder, LiftState
from ...engine.job.folder import BAKE
from ...engine.job.follower import LiftFollower, LiftStatus, Outcome
from ...engine.job.process import engine_command
from ..panel_words import in_panel_words

_POLL_S = 0.05


@dataclass
class Watch:
    """One followed lift, started here or by somebody else. ``state`` is how far it was when it was last looked at."""

    follower: LiftFollower
    state: LiftState = LiftState.RUNNING
    _pictures_seen: int = 0

    @property
    def folder(self) -> LiftFolder:
        return self.follower.folder

    @property
    def status(self) -> LiftStatus:
        return self.follower.status

    @property
    def outcome(self) -> Outcome | None:
        """None while it goes on."""
        return self.follower.outcome

    @property
    def is_running(self) -> bool:
        return self.outcome is None

    @property
    def is_finished(self) -> bool:
        """Whether the lift has a whole result; that may be so while more of its passes are baked."""
        return self.state is LiftState.FINISHED

    @property
    def is_baking(self) -> bool:
        """Whether what is followed is not the lift itself, but a later bake of more frames."""
        return self.status.task == BAKE

    @property
    def ended_well(self) -> bool:
        return self.outcome is not None and self.outcome.code is ExitCode.FINISHED

    @property
    def can_be_resumed(self) -> bool:
        """Whether an engine could go on with it."""
        return self.state not in (LiftState.RUNNING, LiftState.FINISHED)

    def new_picture(self) -> Path | None:
        """The live preview, when it was replaced since the last time that this was asked."""
        before, self._pictures_seen = self._pictures_seen, self.status.live_previews
        return self.status.live_preview if before != self._pictures_seen else None

    def poll(self) -> bool:
        """Take in what happened; whether anything did."""
        if not self.is_running:
            return False
        events = []
        try:
            events = self.follower.poll()
            if self.outcome is not None:
                self.state = self.folder.state_at_a_glance()
                self.follower.close()
        except (JobError, OSError) as error:  # its disk is gone, or the folder was deleted meanwhile
            self.follower.outcome = Outcome(ExitCode.INTERNAL_ERROR, f"the lift can no longer be read: {error}")
            self.state = LiftState.INTERRUPTED
        return bool(events) or not self.is_running


_watches: dict[Path, Watch] = {}
_Refusal = JobError | OSError | ValueError
_refusals: dict[Path, _Refusal] = {}


def watch_of(folder: Path) -> Watch | None:
    """The watch over the lift in this folder (absolute), None when it is not followed."""
    return _watches.get(folder)


def refusal_of(folder: Path) -> _Refusal | None:
    """Why the lift in this folder could not be looked at, None when it could."""
    return _refusals.get(folder)


def running() -> list[Watch]:
    """All followed lifts that go on."""
    return [watch for watch in _watches.values() if watch.is_running]


def start(lift: LiftFolder, python: Path, *, resume: bool = False, keep_running: bool = False) -> Watch:
    """Start an engine on a lift folder and follow it.

    With ``keep_running`` it outlives this Blender. Raises JobError when an engine is at work there already, or when
    it does not start.
    """
    _refuse_running(lift)
    command = engine_command(python, lift.path, resume=resume)
    follower = LiftFollower.start(lift, resume=resume, command=command, stays_with_parent=not keep_running)
    return _follow(Watch(follower))


def bake(
    lift: LiftFolder,
    python: Path,
    frames: Sequence[str] = (),
    *,
    cameras: Path | None = None,
    keep_running: bool = False,
) -> Watch:
    """Let an engine bake more passes of a finished lift: of frames ("test", "all", or names), or of the ``cameras`` of
    a file. Another process may bake the same lift at the same time. Raises JobError.
    """
    known = _watches.get(lift.path)
    if known is not None and known.is_running and known.follower.is_of_our_own:
        raise JobError("this Blender bakes or lifts here already", lift.path, "Wait for it, or cancel it first.")
    if not lift.manifest_path.is_file():
        _refuse_running(lift)
    stays = not keep_running
    return _follow(Watch(LiftFollower.start_bake(lift, python, frames, cameras=cameras, stays_with_parent=stays)))


def attach(folder: Path) -> Watch:
    """Follow a lift that somebody else started, or look at one that has ended. Raises JobError when it is no lift."""
    known = _watches.get(folder)
    if known is not None and known.is_running:
        return known
    lift = LiftFolder.open(folder)
    watch = Watch(LiftFollower(lift), state=lift.state())
    if watch.state is LiftState.NOT_STARTED:
        watch.follower.outcome = Outcome(ExitCode.CANCELLED)
    watch.poll()
    return _follow(watch)


def look_at(folder: Path) -> Watch | None:
    """Follow the lift in a folder if there is one; `refusal_of` keeps what is wrong with it. Never raises."""
    known = _watches.get(folder)
    if known is not None:
        return known
    _refusals.pop(folder, None)
    try:
        return attach(folder) if folder.exists() else None
    except (JobError, OSError, ValueError) as error:  # ValueError: no path of this system can be so
        _refusals[folder] = error
        return None


def poll_all() -> list[Watch]:
    """Poll every running lift once; those with news."""
    return [watch for watch in running() if watch.poll()]


def wait_for(watch: Watch) -> Outcome:
    """Block until a lift has ended: for scripts and Blender without a window."""
    while watch.outcome is None:
        watch.poll()
        time.sleep(_POLL_S)
    return watch.outcome


def let_go() -> None:
    """Forget all lifts. Engines of our own stop, unless they were asked to go on; they can be resumed."""
    for watch in _watches.values():
        watch.follower.close()
    _watches.clear()
    _refusals.clear()


def message_for(watch: Watch) -> str:
    """One line for people about how a lift, or the baking of its passes, ended."""
    outcome = watch.outcome
    if outcome is None:
        return watch.status.label
    if outcome.error is not None:
        return in_panel_words(outcome.error)
    if watch.is_baking:
        return "The passes are baked" if outcome.code is ExitCode.FINISHED else "Baking was cancelled"
    if watch.is_finished:
        return "The lift is finished"
    return "The lift was not started" if watch.state is LiftState.NOT_STARTED else "The lift was cancelled"


def _refuse_running(lift: LiftFolder) -> None:
    if lift.is_running:
        raise JobError("another engine is at work here", lift.path, "Watch it, or cancel it first.")


def _follow(watch: Watch) -> Watch:
    before = _watches.get(watch.folder.path)
    if before is not None:
        before.follower.close()
    _watches[watch.folder.path] = watch
    _refusals.pop(watch.folder.path, None)
    return watch
