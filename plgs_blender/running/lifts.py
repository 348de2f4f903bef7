"""The lifts that this Blender follows, by folder: started, watched, cancelled, resumed, and baked further."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import ErrorCode, PlgsError
from ...engine.job import LiftFolder, LiftState
from ...engine.job.events import at_work
from ...engine.job.follower import TaskFollower, start_bake
from ...engine.job.process import engine_command
from ...engine.job.recent import RecentLift, recent_lifts
from ...engine.job.task import BAKE, LIFT, TaskState
from ..inspecting.views import look_at_placed
from ..lift_collection import Placed, is_placed
from ..lift_scene import place_passes_anew, place_room, reading_lift, result_of
from ..settings import adopt, chosen_lift
from ..startup_file import taking_over
from ..tasks import registry, timer
from ..tasks.registry import Task
from . import exports, live_preview

_SHOWN_RECENT = 8
"""At most this many recent lifts are listed in the panel."""


class Lift(Task):
    """A followed lift, or a later bake of its frames, started here or by somebody else.

    ``lift_state`` is how far the lift was when its folder was last looked at.
    """

    kind, cancel_operator = "lift", "plgs.cancel_lift"

    def __init__(self, follower: TaskFollower, lift_state: LiftState = LiftState.RUNNING, is_new: bool = False) -> None:
        super().__init__(follower)
        assert follower.lift is not None
        self.folder: LiftFolder = follower.lift
        self.lift_folder = follower.lift.path
        self.label = f"{'Baking' if self.is_baking else 'Lifting'} {follower.lift.path.name}"
        self.lift_state, self._is_new, self._was_watched = lift_state, is_new, lift_state is LiftState.RUNNING
        self._pictures_seen = 0
        self.scene_is_there = os.path.exists(follower.lift.request.scene)

    @property
    def key(self) -> Hashable:
        return self.kind, self.folder.path

    @property
    def is_baking(self) -> bool:
        """Whether it is not the lift itself, but a later bake of more frames."""
        return self.follower.kind == BAKE

    @property
    def is_finished(self) -> bool:
        """Whether the lift has a whole result. That may be so while more of its passes are baked."""
        return self.lift_state is LiftState.FINISHED

    @property
    def can_be_resumed(self) -> bool:
        """Whether an engine could go on with it."""
        return self.lift_state not in (LiftState.RUNNING, LiftState.FINISHED)

    @property
    def message(self) -> str:
        """One line about its success, or that it was cancelled."""
        if self.is_baking:
            return "The passes are baked" if self.state is TaskState.FINISHED else "Baking was cancelled"
        if self.is_finished:
            return "The lift is finished"
        return "The lift was not started" if self.lift_state is LiftState.NOT_STARTED else "The lift was cancelled"

    def _is_wanted(self, scene: Any) -> bool:
        """Whether a scene is set to this lift, and wants its result."""
        return bool(scene.plgs.place_when_done) and chosen_lift(scene.plgs) == self.folder.path

    def done(self, scene: Any) -> Iterator[object]:
        """Put a finished result into the scene if that is still set to it and wants it; baked passes wherever it is."""
        try:
            self.lift_state = self.folder.state_at_a_glance()
        except (PlgsError, OSError):  # its disk is gone, or the folder was deleted
            self.lift_state = LiftState.INTERRUPTED
        if self._is_new and self.error is not None and self.folder.came_to_nothing():
            self.folder.discard()  # so that the lift can be started again once the scene is fixed
        refresh_recent()
        if not self.has_finished:
            return
        if self.is_baking and is_placed(self.folder.path, scene):
            place_passes_anew(self.folder.path, scene)
        elif not self._is_wanted(scene) or (yield from showing_lift(scene, self.folder, self._is_wanted)) is None:
            return
        elif self._was_watched and exports.can_make_meshes_unasked():
            exports.make_meshes(self.folder.path, scene, asked=False)
        self.undo_step = "Show Result"

    def watch(self, scenes: Sequence[Any], has_news: bool) -> bool:
        """Bring the live preview up to date."""
        if not self.is_running:
            live_preview.forget(self.folder.path)
            return True
        live_preview.follow_camera(self.folder, scenes)
        progress, before = self.progress, self._pictures_seen
        self._pictures_seen = progress.live_previews
        if progress.live_preview is None or before == progress.live_previews:
            return False
        return live_preview.show(self.folder, progress.live_preview, progress.live_preview_camera)

    def let_go(self) -> None:
        """An engine of our own ends within a second, unless it outlives Blender. The lift can be resumed."""
        self.follower.close()


_refusals: dict[Path, PlgsError | OSError | ValueError] = {}
_nothing_there: set[Path] = set()
_recent: tuple[RecentLift, ...] = ()


def lift_of(folder: Path) -> Lift | None:
    """The lift in this folder (absolute), None when it is not followed."""
    task = registry.task_of((Lift.kind, folder))
    return task if isinstance(task, Lift) else None


def refusal_of(folder: Path) -> PlgsError | OSError | ValueError | None:
    """Why the lift in this folder could not be looked at, None when it could."""
    return _refusals.get(folder)


def is_nothing_there(folder: Path) -> bool:
    """Whether there was no lift folder when it was chosen. Never reads the disk."""
    return folder in _nothing_there


def forget_refusals() -> None:
    _refusals.clear()
    _nothing_there.clear()


def running() -> list[Lift]:
    """All followed lifts that are still running."""
    return registry.running(Lift)


def refresh_recent() -> None:
    """Read the user's list of lifts, which takes some milliseconds."""
    global _recent
    _recent = tuple(recent_lifts(most=_SHOWN_RECENT))


def recent() -> tuple[RecentLift, ...]:
    """The recent lifts as they were at the last `refresh_recent`, the newest first. Never reads the disk."""
    return _recent


def start(lift: LiftFolder, python: Path, *, resume: bool = False, keep_running: bool = False) -> Lift:
    """Start an engine on a lift folder and follow it. With ``keep_running`` it outlives this Blender.

    Raises PlgsError when an engine is at work there already or does not start, OSError.
    """
    _refuse_running(lift)
    command = engine_command(python, lift.path, resume=resume)
    started = TaskFollower.start(command, lift.place, kind=LIFT, lift=lift, stays_with_parent=not keep_running)
    return _follow(Lift(started, is_new=not resume))


def bake(
    lift: LiftFolder,
    python: Path,
    frames: Sequence[str] = (),
    *,
    cameras: Path | None = None,
    layers: Sequence[str] = (),
    keep_running: bool = False,
) -> Lift:
    """Let an engine bake more passes of a finished lift: of frames ("test", "all", or names), or of the ``cameras`` of
    a file, with these of FURTHER_LAYERS. Another process may bake the same lift at the same time. Raises PlgsError,
    OSError.
    """
    known = lift_of(lift.path)
    if known is not None and known.is_running and known.follower.is_own:
        fix = "Wait for it, or cancel it first."
        raise PlgsError("this Blender is already baking or lifting here", lift.path, fix, code=ErrorCode.BUSY)
    if known is not None and known.is_being_taken:
        raise PlgsError("its result is being placed", lift.path, "Wait a moment.", code=ErrorCode.BUSY)
    if not lift.manifest_path.is_file():
        _refuse_running(lift)
    ties = not keep_running
    return _follow(Lift(start_bake(lift, python, frames, cameras=cameras, layers=layers, stays_with_parent=ties)))


def attach(folder: Path) -> Lift:
    """Follow a lift that somebody else started, or look at one that has ended. Raises PlgsError for any other
    folder."""
    known = lift_of(folder)
    if known is not None and known.is_running:
        return known
    lift = LiftFolder.open(folder)
    state = lift.state()
    task = Lift(TaskFollower.attach(lift.place, lift=lift), state)
    if state is not LiftState.RUNNING:  # nobody asked for its result yet
        task.is_taken = True
        if state is LiftState.NOT_STARTED:
            task.follower.state = TaskState.CANCELLED
        else:
            task.follower.poll()
    return _follow(task)


def look_at(folder: Path) -> Lift | None:
    """Follow the lift in a folder if there is one; `refusal_of` keeps what is wrong with it. Never raises."""
    known = lift_of(folder)
    if known is not None:
        return known
    _refusals.pop(folder, None)
    _nothing_there.discard(folder)
    try:
        if folder.exists():
            return attach(folder)
        _nothing_there.add(folder)
        return None
    except (PlgsError, OSError, ValueError) as error:  # ValueError: this system has no such path
        _refusals[folder] = error
        return None


def show_lift(scene: Any, lift: LiftFolder) -> Any:
    """Put a finished lift into the scene, let the panel say what it was asked for, and return its collection. The 3D
    views look at it. Raises PlgsError.
    """
    placed = result_of(showing_lift(scene, lift))
    found = placed.find() if placed is not None else None
    return found[0] if found is not None else None


def showing_lift(
    scene: Any, lift: LiftFolder, is_wanted: Callable[[Any], bool] = lambda scene: True
) -> Generator[None, None, Placed | None]:
    """`show_lift` in parts, for a window that must not wait. Returns where it is; None when the scene is gone once the
    lift is read, or no longer wants it. Raises PlgsError.
    """
    name = scene.name
    read = yield from reading_lift(lift.path)
    scene = bpy.data.scenes.get(name)  # undo may have put another one in its place
    if scene is None or not is_wanted(scene):
        return None
    with taking_over(scene):
        placed = place_room(read, scene)
    adopt(scene.plgs, lift.request, lift.path)
    yield
    next(placed.rest, None)
    yield
    found = placed.at.find()
    if found is not None:
        look_at_placed(*found)
    yield
    yield from placed.rest
    return placed.at


def _refuse_running(lift: LiftFolder) -> None:
    if lift.is_running:
        raise at_work(lift.events_path)


def _follow(task: Lift) -> Lift:
    _refusals.pop(task.folder.path, None)
    return timer.begin(task)
