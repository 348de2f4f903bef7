"""Read without being asked: the chosen scene, the chosen lift, and the lifts of an opened file."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import bpy

from ...engine.errors import PlgsError
from ...engine.job.folder import refuse_foreign
from ...engine.job.recent import remembered_lifts
from ...engine.result_files import INSTANCES
from .. import corrections
from .. import settings as panel
from ..chosen_scene import ChosenScene, absolute
from ..engine_environment import engine_python
from ..engine_environment.tasks import when_ready
from ..owned import FOLDER, folder_of, gone, lifts_in, text_of
from ..results import begin_to_read, read_on
from ..settings import PLGS_PG_settings, chosen_lift, chosen_scene
from ..viewport import look_first
from . import estimate, lifts, survey

_PARTS_S = 0.02  # seconds of reading a list without a pause, and of the pause


def look_at_scene(chosen: ChosenScene) -> None:
    """Read what is in a scene's folder. `survey.survey_of` then returns it; in a window, a moment later."""
    estimate.learn_slowness()
    # Without a window nothing polls an engine, and reading it here keeps nobody waiting.
    survey.look(chosen, None if bpy.app.background else engine_python())


def find_own_lifts() -> None:
    """Follow the lifts that the open file's scenes name or show, if they are in this user's list or beside the file.
    Other paths, and the scene's folder, are read only when the user asks, as somebody else's file may name any path,
    such as a FIFO or a disk that never answers."""
    for scene in bpy.data.scenes:
        folder = lifts.shown_lift(scene.plgs)
        if folder is not None and _is_own(folder):
            lifts.look_at(folder)


def _is_own(lift: Path) -> bool:
    """Whether a lift is in this user's list, or near the open file: the same as, beside, above or below its folder."""
    if str(lift) in remembered_lifts():
        return True
    here = absolute("//") if bpy.data.filepath else None
    return here is not None and {here, here.parent} & {lift, lift.parent} != set() and not lift.is_symlink()


def begin_to_read_objects() -> None:
    """Start reading the objects of the lift that the open file shows, so that edits need not wait for them. Note which
    of its lifts have changed or are gone. Only the user's own lifts are read, and no links out of them are followed."""
    roots = [root for scene in (bpy.context.scene, *bpy.data.scenes) for root in lifts_in(scene)]
    shown = {folder_of(root): root for root in reversed(roots) if text_of(root, FOLDER)}
    corrections.outdated.clear()
    gone.clear()
    for folder, root in shown.items():
        if _is_own(folder):
            with suppress(PlgsError, OSError):  # an edit reads it again and reports the error
                refuse_foreign(folder, f"result/{INSTANCES}")  # passes are not checked: there may be thousands
                corrections.look_for_changes(root)
                begin_to_read(folder)  # only the last, which the window shows


def _read_objects() -> float | None:
    try:
        return _PARTS_S if read_on(_PARTS_S) else None
    except PlgsError:  # an edit reads it again and reports the error
        return None


def _on_scene_chosen(settings: PLGS_PG_settings) -> None:
    look_at_scene(chosen_scene(settings))


def _on_lift_chosen(settings: PLGS_PG_settings) -> None:
    folder = chosen_lift(settings)
    if folder is not None:
        lifts.look_at(folder)


def _when_engine_is_ready() -> None:
    """Read again the chosen scenes that Blender could not fully read without an engine."""
    for scene in bpy.data.scenes:
        seen = survey.survey_of_panel(scene.plgs)
        if seen is not None and seen.has_masks is None:
            look_at_scene(seen.chosen)
        elif seen is not None and seen.error is not None and seen.error.key == "needs-engine":
            look_at_scene(seen.chosen)


def _at_start() -> None:
    lifts.refresh_recent()
    find_own_lifts()


@bpy.app.handlers.persistent
def _on_load(*_: object) -> None:
    find_own_lifts()
    begin_to_read_objects()
    if not bpy.app.background:
        bpy.app.timers.register(_read_objects, first_interval=_PARTS_S)
        bpy.app.timers.register(look_first, first_interval=_PARTS_S)


HANDLERS = (("load_post", _on_load),)


def register() -> None:
    panel.on_scene_chosen.append(_on_scene_chosen)
    panel.on_lift_chosen.append(_on_lift_chosen)
    when_ready.append(_when_engine_is_ready)
    # A moment later: while extensions are switched on there is no file to look at.
    if not bpy.app.background:
        bpy.app.timers.register(_at_start, first_interval=0.0)


def unregister() -> None:
    panel.on_scene_chosen.remove(_on_scene_chosen)
    panel.on_lift_chosen.remove(_on_lift_chosen)
    when_ready.remove(_when_engine_is_ready)
    for each in (_at_start, _read_objects, look_first):
        if bpy.app.timers.is_registered(each):
            bpy.app.timers.unregister(each)
    lifts.refusals.clear()
    lifts.nothing_there.clear()
    lifts.forget()
