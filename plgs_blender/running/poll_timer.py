"""A timer of Blender's that polls the followed lifts and shows what is new.

It survives undo, the opening of another file and the end of the operator that started a lift. Blender runs it in its
own main thread between redraws, so it may never wait.
"""

from __future__ import annotations

from pathlib import Path

import bpy

from ...engine.job.recent import remembered_lifts
from .. import scene_survey
from ..engine_environment import engine_python
from ..paths import absolute
from ..redrawing import redraw_panels
from ..scene_survey import Place
from . import exports, frame_making, lifts, live_preview, machine_pace, recents
from .lifts import Watch

TICK_S = 0.1


def begin() -> None:
    """Start the timer; it goes on as long as there are lifts to follow. Without a window there is none."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_S, persistent=True)


def tick() -> float | None:
    """Poll once; the seconds until the next time, None when there is nothing left to follow."""
    with_news = lifts.poll_all()
    shown_anew = [_show(watch) for watch in with_news]
    for watch in lifts.running():
        live_preview.follow_camera(watch.folder, _scenes())
    was_looking = scene_survey.is_looking()
    is_looking = scene_survey.poll()
    was_making, frames_are_made = frame_making.is_making(), frame_making.poll()
    if frames_are_made:
        remember_step("PLGS Frames")
    if exports.poll() or with_news or was_looking != is_looking or was_making:
        redraw_panels(views_too=any(shown_anew) or frames_are_made)
    goes_on = lifts.running() or is_looking or frame_making.is_making() or exports.is_running()
    return TICK_S if goes_on else None


def remember_step(name: str) -> None:
    """Let undo take back what the timer put into the scene, and nothing before it."""
    window = next(iter(bpy.context.window_manager.windows), None)
    if window is not None:
        with bpy.context.temp_override(window=window):
            bpy.ops.ed.undo_push(message=name)


def look_at_scene(place: Place) -> None:
    """See what is in a scene's folder; `scene_survey.survey_of` knows it then: in a window a moment later."""
    machine_pace.learn()
    # Without a window nobody would hear what a process finds out, and nobody is kept waiting.
    scene_survey.look(place, None if bpy.app.background else engine_python())
    begin()


def look_at_lift(folder: Path) -> None:
    """Follow the lift in this folder, if there is one: running or ended, of this Blender or another."""
    if lifts.look_at(folder) is not None:
        begin()


def _show(watch: Watch) -> bool:
    """Bring the live preview up to date; whether that changes what a view shows."""
    if not watch.is_running:
        live_preview.forget(watch.folder.path)
        recents.refresh()
        return True
    picture = watch.new_picture()
    if picture is not None:
        return live_preview.show(watch.folder, picture, watch.status.live_preview_camera)
    return False


def _scenes() -> list[bpy.types.Scene]:
    """All scenes of the file, those that windows show first."""
    return [*(window.scene for window in bpy.context.window_manager.windows), *bpy.data.scenes]


def find_own_lifts() -> None:
    """Find the lifts again that the scenes of the open file were working on: those of this user's own list.

    A file may come from somebody else, and name any path: a FIFO, or a disk that never answers. What this user's
    engines have not worked on is looked at when somebody asks for it, and so is the scene's folder.
    """
    own = {Path(path) for path in remembered_lifts()}
    for scene in bpy.data.scenes:
        if scene.plgs.lift_folder and absolute(scene.plgs.lift_folder) in own:
            look_at_lift(absolute(scene.plgs.lift_folder))


def _at_start() -> None:
    recents.refresh()
    find_own_lifts()


@bpy.app.handlers.persistent
def _on_load(*_: object) -> None:
    find_own_lifts()


def register() -> None:
    bpy.app.handlers.load_post.append(_on_load)
    # Not now: while extensions are switched on there is no file to look at.
    if not bpy.app.background:
        bpy.app.timers.register(_at_start, first_interval=0.0)


def unregister() -> None:
    """Stop, and let go of the lifts: engines of our own end, unless they were asked to go on."""
    bpy.app.handlers.load_post.remove(_on_load)
    for timer in (tick, _at_start):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    scene_survey.stop_looking()
    frame_making.forget()
    lifts.let_go()
    exports.let_go()
    live_preview.forget()
