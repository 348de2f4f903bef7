"""The heartbeat: a timer of Blender's that polls the followed lifts and shows what is new.

It survives undo, the opening of another file and the end of the operator that started a lift. Blender runs it in its
own main thread between redraws, so it may never wait: `longest_tick_s` tells how long it took at worst.
"""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from .. import scene_survey
from ..engine_environment import engine_python
from ..paths import absolute
from ..scene_survey import Place
from . import estimate, lifts, live_preview, recents
from .lifts import Watch

TICK_S = 0.1
_longest_tick_s = 0.0


def begin() -> None:
    """Let the heart beat from now on, as long as there are lifts to follow. Without a window nothing beats."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_S, persistent=True)


def tick() -> float | None:
    """One beat; the seconds until the next, None when there is nothing left to follow."""
    global _longest_tick_s
    began = time.perf_counter()
    with_news = lifts.poll_all()
    shown_anew = [_show(watch) for watch in with_news]
    for watch in lifts.running():
        live_preview.follow_camera(watch.folder, bpy.data.scenes)
    was_looking = scene_survey.is_looking()
    is_looking = scene_survey.poll()
    if with_news or was_looking != is_looking:
        redraw_panels(views_too=any(shown_anew))
    _longest_tick_s = max(_longest_tick_s, time.perf_counter() - began)
    return TICK_S if lifts.running() or is_looking else None


def look_at_scene(place: Place) -> None:
    """See what is in a scene's folder; `scene_survey.survey_of` knows it then, the rest a moment later."""
    estimate.learn_machine()
    scene_survey.look(place, engine_python())
    begin()


def look_at_lift(folder: Path) -> None:
    """Follow the lift in this folder, if there is one: running or ended, of this Blender or another."""
    if lifts.look_at(folder) is not None:
        begin()


def longest_tick_s() -> float:
    """The longest time, in seconds, that one beat has kept Blender's window waiting since the extension was loaded."""
    return _longest_tick_s


def redraw_panels(*, views_too: bool = False) -> None:
    """Ask for the sidebars to be drawn anew, and only if asked the views beside them: those take far longer."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI" or (views_too and region.type == "WINDOW"):
                        region.tag_redraw()


def _show(watch: Watch) -> bool:
    """Bring the camera's background up to date; whether that changes what a view shows."""
    if not watch.is_running:
        live_preview.remove(watch.folder, bpy.data.scenes)
        recents.refresh()
        return True
    picture = watch.new_picture()
    if picture is not None:
        live_preview.show(watch.folder, picture, bpy.data.scenes)
        return True
    return False


def look_at_all_scenes() -> None:
    """Find the lifts again that the scenes of the open file were working on, and see which others there are."""
    recents.refresh()
    for scene in bpy.data.scenes:
        if scene.plgs.lift_folder:
            look_at_lift(absolute(scene.plgs.lift_folder))


@bpy.app.handlers.persistent
def _on_load(*_: object) -> None:
    look_at_all_scenes()


def register() -> None:
    bpy.app.handlers.load_post.append(_on_load)
    # Not now: while extensions are switched on there is no file to look at.
    if not bpy.app.background:
        bpy.app.timers.register(look_at_all_scenes, first_interval=0.0)


def unregister() -> None:
    """Stop, and let go of the lifts: engines of our own end, unless they were asked to go on."""
    bpy.app.handlers.load_post.remove(_on_load)
    for timer in (tick, look_at_all_scenes):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    scene_survey.stop_looking()
    lifts.let_go()
