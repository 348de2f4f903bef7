"""From what the panel says to a running lift, and from a finished one to objects in the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy

from ...engine.job import JobError, LiftFolder
from ...engine.scene import open_scene_to_lift
from .. import engine_environment
from ..lift_collection import lift_of_scene
from ..lift_scene import place_lift
from ..meshes import mesh_folder
from ..owned import text_of
from ..panel_words import in_panel_words
from ..paths import absolute, free_lift_folder
from ..possibilities import why_not_liftable
from ..scene_survey import survey_of
from ..settings import PLGS_PG_settings, adopt, chosen_lift, place_of, request_of, why_no_options
from ..shots import ShotReader, shot_of
from . import exports, lifts
from .lifts import Watch


def followed_lift(settings: PLGS_PG_settings) -> Watch | None:
    """The lift that the panel is set to, when it is followed."""
    folder = chosen_lift(settings)
    return None if folder is None else lifts.watch_of(folder)


def why_no_engine() -> str | None:
    """Why no engine can be started now; None when one can. Looks at no disk."""
    engine = engine_environment.status()
    return None if engine.is_usable else f"{engine.message}. {engine.fix}"


def why_no_scene(settings: PLGS_PG_settings) -> str | None:
    """Why the panel's scene cannot be used; None when it can, or nobody knows yet. Looks at no disk."""
    if not settings.scene_folder:
        return "Choose the scene's folder first"
    survey = survey_of(place_of(settings))
    return None if survey is None or survey.error is None else in_panel_words(f"{survey.error}. {survey.fix}")


def why_no_lift(settings: PLGS_PG_settings) -> str | None:
    """Why the panel's lift cannot be started now; None when it can. Looks at no disk."""
    followed = followed_lift(settings)
    if followed is not None and followed.is_running:
        return "This lift is running already"
    survey = survey_of(place_of(settings)) if settings.scene_folder else None
    return why_no_options(settings) or why_no_scene(settings) or (None if survey is None else why_not_liftable(survey))


def earlier_lift(settings: PLGS_PG_settings) -> Path | None:
    """The lift whose objects keep their names: that of the same scene which the settings' scene shows, if it is whole
    and names shall be kept."""
    if not settings.keep_names or not settings.scene_folder:
        return None
    found = lift_of_scene(absolute(settings.scene_folder), settings.id_data)
    return found if found is not None and (found / "result" / "manifest.json").is_file() else None


def start_lift(settings: PLGS_PG_settings, *, in_that_folder: bool = False, names_from: str = "") -> Watch:
    """Start the lift that the settings ask for: in their lift folder or, where that holds a lift already, in a new one
    beside the scene's; with ``in_that_folder`` such a folder is refused. Objects are called as in ``names_from``, or
    as in `earlier_lift`.

    Raises JobError or SceneError, and then leaves no folder behind.
    """
    if not settings.scene_folder:
        raise JobError("no scene is chosen", "Scene", "Choose a folder with color, depth, pose and intrinsic.")
    python = engine_environment.usable_python()
    request = replace(request_of(settings), names_from=absolute(names_from) if names_from else earlier_lift(settings))
    known = survey_of(place_of(settings))
    # Else the panel looks, or has looked, and a button answers at once.
    if known is None or known.error is not None or why_not_liftable(known) is not None:
        open_scene_to_lift(request)
    folder = chosen_lift(settings)
    if folder is None or (not in_that_folder and (folder / "request.json").exists()):
        folder = free_lift_folder(request.scene)
    lift = LiftFolder.create(folder, request)
    try:
        followed = lifts.start(lift, python, keep_running=settings.keep_running)
    except JobError:
        lift.discard()
        raise
    settings.lift_folder = str(folder)
    return followed


def resume_lift(settings: PLGS_PG_settings, folder: str = "") -> Watch:
    """Go on with the lift in `folder`, or in that of the settings, which then say what it was asked for.

    Raises JobError when there is none, it is running, or it is finished.
    """
    lift = lift_at(settings, folder)
    known = lifts.attach(lift.path)
    if not known.can_be_resumed:
        fix = "Watch it, or cancel it first." if known.is_running else "Lift into another folder."
        raise JobError(f"cannot be resumed: it is {known.state.value}", lift.path, fix)
    followed = lifts.start(lift, engine_environment.usable_python(), resume=True, keep_running=settings.keep_running)
    adopt(settings, lift.request, lift.path)
    return followed


def join_lift(settings: PLGS_PG_settings, folder: str = "") -> Watch:
    """Follow the lift in `folder`, or in that of the settings, which then say what was asked. Raises JobError."""
    lift = lift_at(settings, folder)
    followed = lifts.attach(lift.path)
    adopt(settings, lift.request, lift.path)
    return followed


def cancel_lift(settings: PLGS_PG_settings, folder: str = "") -> None:
    """Ask a lift to stop. Raises JobError when it is not running, or its folder cannot be written."""
    lift = lift_at(settings, folder)
    followed = lifts.watch_of(lift.path) or lifts.attach(lift.path)
    if not followed.is_running:
        raise JobError(f"is not running: it is {followed.state.value}", lift.path, "There is nothing to cancel.")
    try:
        followed.follower.cancel()
    except OSError as error:
        fix = "Ask whoever started it to cancel it."
        raise JobError(f"cannot be cancelled from here ({error.strerror})", lift.path, fix) from error


def why_no_bake(settings: PLGS_PG_settings) -> str | None:
    """Why no passes can be baked from the panel now; None when they can. Looks at no disk."""
    followed = followed_lift(settings)
    if followed is None or not (followed.is_finished or followed.is_running):
        return "Passes are baked from a finished lift: lift the scene first, or choose the folder of a lift"
    return "The lift is still running" if followed.is_running else None


def bake_passes(scene: bpy.types.Scene, frames: str, folder: str = "") -> Watch:
    """Let an engine bake passes of a finished lift: of "all" frames, the held-out ones ("test"), or that of the scene's
    "active" camera. Raises JobError.
    """
    lift = lift_at(scene.plgs, folder)
    names = [frames]
    if frames == "active":
        names = [text_of(scene.camera, "frame")] if scene.camera is not None else [""]
        if not names[0]:
            fix = "Choose one of the lift's cameras: select it and press Ctrl+Numpad 0."
            raise JobError("the active camera is no frame of the lift", scene.name, fix)
    python = engine_environment.usable_python()
    return lifts.bake(lift, python, names, keep_running=scene.plgs.keep_running)


def read_camera(
    scene: bpy.types.Scene, camera: str, frames: tuple[int | None, int | None, int | None]
) -> ShotReader:
    """Begin to read a camera, the scene's active one unless named, over ``frames`` (first, last, step), the scene's
    where None. Raises JobError, also where there is no engine to bake it.
    """
    engine_environment.usable_python()
    return ShotReader(scene, shot_of(scene, camera, *frames))


def bake_shot(scene: bpy.types.Scene, shot: ShotReader, folder: str = "") -> Watch:
    """Let an engine bake passes of a finished lift from a camera that is read. Views that were baked from the same
    camera are kept. Raises JobError.
    """
    lift = lift_at(scene.plgs, folder)
    cameras, python = shot.write(lift.path), engine_environment.usable_python()
    return lifts.bake(lift, python, cameras=cameras, keep_running=scene.plgs.keep_running)


def export_lift(settings: PLGS_PG_settings, form: str, output: str, frames: str, folder: str = "") -> exports.Export:
    """Let an engine export a finished lift into the folder ``output``; meshes without one into the lift's own, from
    where they are put into the scene. Raises JobError, OSError.
    """
    lift = lift_at(settings, folder)
    if not output and form != "mesh":
        raise JobError("needs a folder", f"Export of {form}", "Choose where the files shall go.")
    target = absolute(output) if output else mesh_folder(lift.path)
    return exports.start(lift.path, form, target, engine_environment.usable_python(), [frames])


def show_lift(scene: bpy.types.Scene, folder: str = "") -> bpy.types.Collection:
    """Put the finished lift in `folder`, or in that of the scene's settings, into the scene.

    Raises JobError or SceneError.
    """
    lift = lift_at(scene.plgs, folder)
    try:
        root = place_lift(lift.path, scene)
    except JobError as error:
        if not lift.is_running:
            raise
        raise JobError("cannot be shown yet: it is still running", lift.path, "Wait until it is finished.") from error
    adopt(scene.plgs, lift.request, lift.path)
    return root


def log_of(settings: PLGS_PG_settings, folder: str = "") -> Path:
    """The engine's log of the lift in `folder`, or in that of the settings. Raises JobError when there is none."""
    log = lift_at(settings, folder).log_path
    if not log.is_file():
        raise JobError("is not there: the engine never began", log, "Start it anew.")
    return log


def lift_at(settings: PLGS_PG_settings, folder: str = "") -> LiftFolder:
    """The lift in `folder`, or in that of the settings. Raises JobError when there is none."""
    path: Path | None = absolute(folder) if folder else chosen_lift(settings)
    if path is None:
        raise JobError("no lift is chosen", "Lift folder", "Start a lift, or choose the folder of one.")
    return LiftFolder.open(path)
