"""The one timer of Blender's that polls all followed tasks and redraws what shows them.

It survives undo, the opening of another file and the end of the operator that started a task. Blender runs it in its
main thread between redraws, so it must never wait.
"""

from __future__ import annotations

import atexit
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from . import registry
from .registry import Kind, Task

TICK_S = 0.1
_CLOCK_S = 1.0
"""Seconds after which panels are drawn again without news, as they count the time."""
_drawn_at = 0.0


def begin(task: Kind) -> Kind:
    """Follow a task until its end. Without a window nothing polls it: then somebody has to wait for it."""
    registry.follow(task)
    go_on()
    return task


def go_on() -> None:
    """Start the timer where there is a window."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_S, persistent=True)


def tick() -> float | None:
    """Poll once. Returns the seconds until the next poll, None when nothing is left to follow."""
    try:
        _poll()
    except Exception:  # a defect of ours: the tasks are followed all the same
        traceback.print_exc()
    return TICK_S if registry.is_any_left() else None


def _poll() -> None:
    with _in_window():
        with_news = registry.poll_all(bpy.context.scene)
        for task in with_news:
            if task.is_taken and task.undo_step and task.has_finished:
                _push_undo(task.undo_step)
        scenes = _scenes()
        watched = [*registry.running(Task), *(task for task in with_news if task.is_taken)]
        are_views_outdated = [task.watch(scenes, task in with_news) for task in watched]
    global _drawn_at
    if with_news or time.monotonic() - _drawn_at > _CLOCK_S:
        _drawn_at = time.monotonic()
        is_file_changed = any(task.is_taken for task in with_news)
        redraw_panels(views_too=is_file_changed or any(are_views_outdated))


def redraw_panels(*, views_too: bool = False) -> None:
    """Redraw the sidebars of 3D views and the preferences. The views themselves take far longer: only if asked."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
            elif area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI" or (views_too and region.type == "WINDOW"):
                        region.tag_redraw()


def _push_undo(step: str) -> None:
    """Let undo remove what a task put into the file, and nothing before it."""
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message=step)


@contextmanager
def _in_window() -> Iterator[None]:
    """Undo steps and view layers need a window, which Blender's timers do not have."""
    window = next(iter(bpy.context.window_manager.windows), None)
    if window is None:
        yield
    else:
        with bpy.context.temp_override(window=window):
            yield


def _scenes() -> list[bpy.types.Scene]:
    """All scenes of the file, those that windows show first."""
    return [*(window.scene for window in bpy.context.window_manager.windows), *bpy.data.scenes]


def register() -> None:
    """Engines of our own end with Blender too, which calls nothing else when it ends."""
    atexit.register(registry.forget_all)


def unregister() -> None:
    """Stop, and forget all tasks: their engines end, unless they were started to outlive Blender."""
    atexit.unregister(registry.forget_all)
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    registry.forget_all()
