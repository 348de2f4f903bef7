"""The tasks that this Blender follows, each an engine command in its own process, and the timer that polls them.

Tasks are kept here, not in an operator or a file, so they survive undo and opening another .blend. The timer runs in
Blender's main thread between redraws, so nothing here waits, and there are no threads."""

from __future__ import annotations

import atexit
import time
import traceback
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import bpy

from ..engine.errors import PlgsError
from ..engine.job.follower import TaskFollower
from ..engine.job.process import engine_call
from ..engine.job.task import TaskFiles, TaskProgress, TaskState
from .chosen_scene import ChosenScene

_POLL_S = 0.05
_PARTS_S = 0.05  # seconds per poll after which no further part of an answer is taken


class Task:
    """A followed engine command, and its outcome. Each kind is a subclass, whose `done` takes the answer."""

    kind: ClassVar[str]
    """The name of the kind. One task of a kind runs at a time, unless their keys differ."""
    label = ""
    """The work in words, such as "Making masks"."""
    cancel_operator: ClassVar[str] = ""
    """The operator that cancels it, or empty."""
    counts_steps: ClassVar[bool] = True
    """Whether its progress is shown in steps, not in percent."""
    lift_folder: Path | None = None
    """The lift folder that it works in, if any."""
    undo_step = ""
    """The name of the undo step for the changes by `done`; empty if there were none."""

    def __init__(self, follower: TaskFollower) -> None:
        self.follower = follower
        self.began = self._estimated_at = time.monotonic()
        self._estimated_left: float | None = None
        self.is_taken = False
        """Whether `done` was called and completed all its parts."""
        self._parts: Iterator[object] | None = None
        self._problem: PlgsError | None = None

    @property
    def key(self) -> Hashable:
        """The key by which a new task replaces an older one."""
        return self.kind

    @property
    def is_running(self) -> bool:
        return self.follower.is_running

    @property
    def is_being_taken(self) -> bool:
        """Whether `done` has not taken all parts of the answer yet."""
        return self._parts is not None and not self.is_taken

    @property
    def state(self) -> TaskState:
        return self.follower.state

    @property
    def has_finished(self) -> bool:
        """Whether the task succeeded and its answer was taken without an error."""
        return self.state is TaskState.FINISHED and self.error is None

    @property
    def was_cancelled(self) -> bool:
        return self.state is TaskState.CANCELLED

    @property
    def progress(self) -> TaskProgress:
        return self.follower.progress

    @property
    def took_s(self) -> float:
        """The seconds since the task began, even in another Blender or on a machine with a different clock."""
        began = self.progress.began or time.time()
        return max(time.monotonic() - self.began, time.time() - began)

    @property
    def left_s(self) -> float | None:
        """The estimated seconds left, counted down since the engine's last estimate; None without one."""
        estimate = self.progress.left_s
        return None if estimate is None else max(0.0, estimate - (time.monotonic() - self._estimated_at))

    @property
    def answer(self) -> Mapping[str, Any] | None:
        return self.follower.answer

    @property
    def error(self) -> PlgsError | None:
        """The engine's error, else the error that occurred when its answer was taken, else None."""
        return self.follower.error or self._problem

    def poll(self, scene: Any) -> bool:
        """Process the engine's new events, and call `done` at the end. Returns whether anything has changed."""
        has_news = self.follower.poll()
        if self.progress.left_s != self._estimated_left:
            self._estimated_left, self._estimated_at = self.progress.left_s, time.monotonic()
        if not self.is_running and not self.is_taken:
            self.is_taken = True  # also after an error, but not if parts are left
            try:
                if self._parts is None:
                    self.follower.close()
                    self._parts = self.done(scene) or iter(())
                began = time.monotonic()
                while time.monotonic() - began < _PARTS_S:
                    next(self._parts)
                self.is_taken = False
            except StopIteration:
                pass
            except PlgsError as error:
                self._problem = error
            except OSError as error:
                self._problem = PlgsError("internal", str(error), "", "")
            return True
        return has_news

    def done(self, scene: Any) -> Iterator[object] | None:
        """Take the answer into Blender, whose current scene is ``scene``. Called once, however the task ended. Slow
        work yields between its parts, where the user may change anything. A PlgsError or OSError becomes `error`."""
        return None

    def watch(self, scenes: Sequence[Any], has_news: bool) -> bool:
        """Called at every tick with all scenes of the file; ``has_news``: `poll` found a change. Returns whether 3D
        views need redrawing."""
        return False

    def cancel(self) -> None:
        """Ask the engine to stop, which takes less than a second. Raises OSError if the engine is somebody else's."""
        self.follower.cancel()

    def let_go(self) -> None:
        """Stop following the task and end its engine."""
        if self.is_running:
            self.follower.kill()
            self.follower.close()


class SceneTask(Task):
    def __init__(self, chosen: ChosenScene, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.chosen = chosen

    def error_for(self, chosen: ChosenScene) -> PlgsError | None:
        """Return the task's error if it has one and concerns this scene, else None."""
        return self.error if chosen == self.chosen else None


Kind = TypeVar("Kind", bound=Task)
_tasks: dict[Hashable, Task] = {}


def start_engine(
    kind: str, python: Path, *arguments: str | Path, variables: Mapping[str, str] | None = None
) -> TaskFollower:
    """Start the engine's command ``kind``, with environment ``variables``; it ends with this Blender. Raises PlgsError
    or OSError if it cannot start."""
    command = [*engine_call(python), kind, *arguments]
    return TaskFollower.start(command, TaskFiles.temporary(), kind=kind, variables=variables or {})


def follow(task: Kind) -> Kind:
    """Follow a task, in place of an earlier task with the same key."""
    forget(task.key)
    _tasks[task.key] = task
    return task


def latest(kind: type[Kind]) -> Kind | None:
    """Return the last followed task of a kind, running or ended; None if none was followed."""
    return next((task for task in reversed(_tasks.values()) if isinstance(task, kind)), None)


def task_of(key: Hashable) -> Task | None:
    """Return the task with this key, None if none is followed."""
    return _tasks.get(key)


def running(kind: type[Kind]) -> list[Kind]:
    """Return the running tasks of a kind; `Task` stands for every kind."""
    return [task for task in _tasks.values() if isinstance(task, kind) and task.is_running]


def refuse_second(kind: type[Task]) -> None:
    """Raise PlgsError if a task of this kind is running."""
    for task in running(kind):
        raise PlgsError("at-work", "an engine is already running", task.label, "Wait until it is done, or cancel it.")


def poll_all(scene: Any) -> list[Task]:
    """Poll all tasks once. Returns those that changed."""
    return [task for task in list(_tasks.values()) if (task.is_running or not task.is_taken) and task.poll(scene)]


def wait_for(task: Task, scene: Any, report: Callable[[str], object] = lambda line: None) -> None:
    """Block until a task has ended and its answer is taken, reporting each new step. Ctrl-C cancels it."""
    reported = ""
    try:
        while task.is_running or not task.is_taken:
            task.poll(scene)
            progress = task.progress
            line = f"{progress.stage_index}/{progress.stage_count} {progress.label}"
            if progress.stage_count and line != reported:
                reported = line
                report(line)
            time.sleep(_POLL_S if task.is_running else 0.0)
    except KeyboardInterrupt:
        with suppress(OSError):
            task.cancel()
        while not task.is_taken:
            task.poll(scene)
            time.sleep(_POLL_S)
        raise


def forget(key: Hashable) -> None:
    """Stop following the task with this key, and drop its outcome."""
    task = _tasks.pop(key, None)
    if task is not None:
        task.let_go()


def forget_all() -> None:
    """Stop following all tasks. Their engines end, unless they should outlive Blender."""
    for key in list(_tasks):
        forget(key)


TICK_S = 0.1
_CLOCK_S = 1.0  # seconds after which panels are redrawn even without news, because they show elapsed time
_drawn_at = 0.0


def begin(task: Kind) -> Kind:
    """Follow a task until its end. Without a window nothing polls the task, so the caller must wait for its end."""
    follow(task)
    go_on()
    return task


def go_on() -> None:
    """Start the timer that polls all tasks (`tick`), if Blender has a window and the timer does not run."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_S, persistent=True)


def tick() -> float | None:
    """Poll all tasks once. Returns the seconds until the next poll; None if nothing is left to follow."""
    try:
        _poll()
    except Exception:  # a bug of ours must not stop the timer
        traceback.print_exc()
    is_any_left = any(task.is_running or not task.is_taken for task in _tasks.values())
    return TICK_S if is_any_left else None


def _poll() -> None:
    with _in_window():
        with_news = poll_all(bpy.context.scene)
        for task in with_news:
            if task.is_taken and task.undo_step and task.has_finished:
                if not bpy.app.background:  # undo then removes what the task added, and nothing before it
                    bpy.ops.ed.undo_push(message=task.undo_step)
        scenes = [*(window.scene for window in bpy.context.window_manager.windows), *bpy.data.scenes]
        watched = [*running(Task), *(task for task in with_news if task.is_taken)]
        are_views_outdated = [task.watch(scenes, task in with_news) for task in watched]
    global _drawn_at
    if with_news or time.monotonic() - _drawn_at > _CLOCK_S:
        _drawn_at = time.monotonic()
        is_file_changed = any(task.is_taken for task in with_news)
        redraw_panels(views_too=is_file_changed or any(are_views_outdated))


def redraw_panels(*, views_too: bool = False) -> None:
    """Redraw the 3D views' sidebars and the preferences; with ``views_too`` also the views, which takes far longer."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
            elif area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI" or (views_too and region.type == "WINDOW"):
                        region.tag_redraw()


@contextmanager
def _in_window() -> Iterator[None]:
    """Give a ``with`` block a window, which undo steps and view layers need and Blender's timers do not have."""
    window = next(iter(bpy.context.window_manager.windows), None)
    if window is None:
        yield
    else:
        with bpy.context.temp_override(window=window):
            yield


def register() -> None:
    atexit.register(forget_all)


def unregister() -> None:
    atexit.unregister(forget_all)
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    forget_all()
