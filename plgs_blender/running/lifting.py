"""Start a lift, a bake or an export from the panel's settings, and put a finished lift into the scene."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import ErrorCode, PlgsError
from ...engine.job import LiftFolder, read_manifest
from ...engine.job.follower import TaskFollower
from ...engine.job.request import PresetName
from .. import engine_environment, registry
from ..chosen_scene import absolute, free_folder
from ..clouds import cloud_folder
from ..engine_environment import why_no_engine
from ..errors import one_line, with_field_names
from ..inspecting.selection import active_lift, find_lift, objects_by_key
from ..lift_scene import result_of
from ..moving import bind
from ..owned import FOLDER, SCENE, Placed, folder_of, is_same_place, lifts_in, root_of_placed, text_of
from ..registry import Task, start_engine
from ..settings import PLGS_PG_settings, adopt, chosen_lift, request_of, why_no_options
from ..shot_bakes import write_farm_job
from ..shots import ShotReader, shot_of, write_view
from . import exports, lifts
from .adding import lacking
from .lifts import Lift
from .survey import survey_of_panel, why_not_liftable


def followed_lift(settings: PLGS_PG_settings) -> Lift | None:
    """Return the lift that the panel shows, if it is followed, else None."""
    folder = lifts.shown_lift(settings)
    return None if folder is None else lifts.lift_of(folder)


def why_no_scene(settings: PLGS_PG_settings) -> str | None:
    """Return why the panel's scene cannot be used; None if it can, or if nobody knows yet. Never reads the disk."""
    if not settings.scene_folder:
        return "Choose the scene's folder first"
    survey = survey_of_panel(settings)
    return None if survey is None or survey.error is None else with_field_names(survey.error)


def why_no_lift(settings: PLGS_PG_settings) -> str | None:
    """Return why the panel's lift cannot be started now, None if it can. Never reads the disk."""
    followed = followed_lift(settings)
    if followed is not None and followed.is_running:
        return "Passes of this lift are being baked" if followed.is_baking else "This lift is already running"
    reason = why_no_engine() or why_no_options(settings) or why_no_device(settings) or why_no_scene(settings)
    survey = survey_of_panel(settings)
    obstacle = None if survey is None else why_not_liftable(survey)
    return reason or (None if obstacle is None else f"No lift: {obstacle}")


def why_no_device(settings: PLGS_PG_settings) -> str | None:
    """Return why the engine cannot lift on the panel's device, by its last answer; or None. Never reads the disk."""
    lacks = lacking("cuda") if settings.device == "cuda" else ()
    needs_torch = "torch for CUDA" in lacks
    fix = "Set the engine up with Torch: CUDA" if needs_torch else "Install gsplat with the engine's own Python"
    return f"Device CUDA: the engine lacks {', '.join(lacks)}. {fix}, or choose CPU" if lacks else None


def earlier_lift(settings: PLGS_PG_settings) -> Path | None:
    """Return the earlier lift of the same scene whose names the objects shall keep; None if Keep Names is off or there
    is no such lift. It must be complete and placed in Blender's scene; the active lift comes first."""
    if not settings.keep_names or not settings.scene_folder:
        return None
    scene, folder = settings.id_data, absolute(settings.scene_folder)
    chosen = active_lift(scene, None)
    roots = sorted(lifts_in(scene), key=lambda root: root != chosen)
    found = [folder_of(root) for root in roots if root[FOLDER] and is_same_place(text_of(root, SCENE), folder)]
    return next((lift for lift in found if (lift / "result" / "manifest.json").is_file()), None)


def start_lift(settings: PLGS_PG_settings, *, in_that_folder: bool = False, names_from: str = "") -> Lift:
    """Start the lift that the settings describe, in their lift folder. If that already holds a lift, use a new folder
    beside the scene or, with ``in_that_folder``, refuse. Objects keep their names in the lift ``names_from``, else in
    `earlier_lift`. Raises PlgsError without scene or engine and for bad options, OSError, and then leaves no folder."""
    if not settings.scene_folder:
        what = "no scene is chosen"
        raise PlgsError("no-scene", what, "Scene", "Choose a capture's folder or file.")
    engine_environment.studio()
    python = engine_environment.usable_python()
    request = replace(request_of(settings), names_from=absolute(names_from) if names_from else earlier_lift(settings))
    folder = chosen_lift(settings)
    if folder is None or (not in_that_folder and (folder / "request.json").exists()):
        folder = free_folder(request.scene, "lift")
    lift = LiftFolder.create(folder, request)
    try:
        followed = lifts.start(lift, python, keep_running=settings.keep_running)
    except PlgsError:
        lift.discard()
        raise
    settings.lift_folder = str(folder)
    return followed


def resume_lift(settings: PLGS_PG_settings, folder: str = "") -> Lift:
    """Continue the lift in `folder`, else in that of the settings, and copy its options to the settings. Raises
    OSError, and PlgsError if there is no lift, or it is running or finished."""
    lift = lift_at(settings, folder)
    known = lifts.attach(lift.path)
    if not known.can_be_resumed:
        fix = "Watch it, or cancel it first." if known.is_running else "Lift into another folder."
        raise PlgsError("not-resumable", f"cannot be resumed: it is {known.lift_state.value}", lift.path, fix)
    followed = lifts.start(lift, engine_environment.usable_python(), resume=True, keep_running=settings.keep_running)
    adopt(settings, lift.request, lift.path)
    return followed


def finer_preset(settings: PLGS_PG_settings, lift: LiftFolder) -> PresetName | None:
    """Return the preset with which the panel would refine a lift: its own choice if that is better than the lift's,
    else the next better one; None if the lift is no draft."""
    if lift.request.preset != "draft":
        return None
    chosen: PresetName = settings.preset
    return chosen if chosen != "draft" else "preview"


def refine_lift(settings: PLGS_PG_settings, folder: str = "") -> Lift:
    """Refine the finished draft in `folder`, else in that of the settings, with the panel's preset, or with Preview.
    Names and corrections stay. Raises OSError, and PlgsError if it is no finished draft, or an engine is at work."""
    lift = lift_at(settings, folder)
    known, preset = lifts.attach(lift.path), finer_preset(settings, lift)
    if not known.is_finished or preset is None:
        what = "is not a finished draft, which alone can be refined"
        raise PlgsError("no-draft", what, lift.path, "Lift by another preset into another folder.")
    python = engine_environment.usable_python()
    lift = lift.refined(preset)
    followed = lifts.start(lift, python, resume=True, keep_running=settings.keep_running)
    adopt(settings, lift.request, lift.path)
    return followed


class SceneFinding(Task):
    """Compares the frames of a folder with those of a lift. If they match, the lift now reads them from that folder."""

    kind, label, undo_step = "find_scene", "Comparing the frames", "Find Scene"

    def __init__(self, lift: LiftFolder, follower: TaskFollower) -> None:
        super().__init__(follower)
        self._lift = lift
        self.message = ""

    def done(self, scene: Any) -> None:
        if self.answer is None:
            return
        self.message = f"The lift now reads {self.answer.get('scene')}"
        lift = LiftFolder.open(self._lift.path)
        lifts.attach(lift.path)
        adopt(scene.plgs, lift.request, lift.path)
        if any(is_same_place(text_of(root, FOLDER), lift.path) for root in lifts_in(scene)):
            result_of(lifts.showing_lift(scene, lift))


def find_scene(scene: bpy.types.Scene, place: Path, folder: str = "") -> SceneFinding:
    """Let an engine change the path of the scene in the lift in `folder`, else in the settings' lift, to ``place``. If
    the lift is shown, its photos appear again. Raises PlgsError without an engine."""
    registry.refuse_second(SceneFinding)
    lift = lift_at(scene.plgs, folder)
    follower = start_engine("find-scene", engine_environment.usable_python(), lift.path, place)
    return registry.begin(SceneFinding(lift, follower))


def join_lift(scene: bpy.types.Scene, folder: str = "") -> Lift:
    """Follow the lift in `folder`, else the settings' lift, and copy its options to the settings. A finished lift is
    put into the scene at the next polls, if the scene wants it. Raises PlgsError if there is no lift."""
    lift = lift_at(scene.plgs, folder)
    followed = lifts.attach(lift.path)
    adopt(scene.plgs, lift.request, lift.path)
    followed.is_taken = False  # so that its result is taken, at the next polls
    registry.go_on()
    return followed


def bind_lift(scene: bpy.types.Scene, active: bpy.types.Object | None, folder: Path) -> str:
    """Bind the shown lift and the panel to the folder it was moved to; return a line about that. Raises PlgsError if
    the folder holds another lift."""
    root = find_lift(scene, active=active)
    bind(root, folder)
    lift = lifts.attach(folder).folder
    adopt(scene.plgs, lift.request, lift.path)
    return f"{one_line(root.name)} is bound to {lift.path}"


def cancel_lift(settings: PLGS_PG_settings, folder: str = "") -> None:
    """Ask a lift to stop. Raises PlgsError if it is not running or its folder cannot be written."""
    lift = lift_at(settings, folder)
    followed = lifts.lift_of(lift.path) or lifts.attach(lift.path)
    if not followed.is_running:
        what = f"is not running: it is {followed.lift_state.value}"
        raise PlgsError("not-running", what, lift.path, "There is nothing to cancel.")
    try:
        followed.cancel()
    except OSError as error:
        fix = "Ask whoever started it to cancel it."
        raise PlgsError("not-cancelled", f"cannot be cancelled from here ({error.strerror})", lift.path, fix) from error


def why_no_bake(settings: PLGS_PG_settings) -> str | None:
    """Return why the panel cannot bake passes now, None if it can. Never reads the disk."""
    followed = followed_lift(settings)
    if followed is None or not (followed.has_result or followed.is_running):
        return "Passes are baked from a finished lift: lift the scene first, or choose a lift's folder"
    if followed.is_running:
        return "Passes are being baked: wait, or cancel it" if followed.is_baking else "The lift is still running"
    return None


def bake_passes(scene: bpy.types.Scene, frames: str, folder: str = "") -> Lift:
    """Let an engine bake ``frames`` of a finished lift: "all", the held-out ones ("test"), or the "active" one. Raises
    PlgsError without an engine, or if the active camera is no frame's; OSError."""
    lift = lift_at(scene.plgs, folder)
    names = [frames]
    if frames == "active":
        names = [text_of(scene.camera, "frame")] if scene.camera is not None else [""]
        if not names[0]:
            fix = "Choose one of the lift's cameras: select it and press Ctrl+Numpad 0."
            raise PlgsError("other-camera", "the active camera does not belong to a frame of the lift", scene.name, fix)
    python = engine_environment.usable_python()
    return lifts.bake(lift, python, names, layers=sorted(scene.plgs.layers), keep_running=scene.plgs.keep_running)


def bake_shot(scene: bpy.types.Scene, shot: ShotReader, folder: str = "", *, replace: bool = False) -> Lift:
    """Let an engine bake passes of a finished lift from a camera that was read. Views already baked from it are kept.
    Raises OSError, and PlgsError, also for the name of another file's shot, unless ``replace``."""
    lift = lift_at(scene.plgs, folder)
    python = engine_environment.usable_python()
    layers, keep_running = sorted(scene.plgs.layers), scene.plgs.keep_running
    cameras = shot.write(lift.path, replace=replace)
    bake = lifts.bake(lift, python, cameras=cameras, layers=layers, keep_running=keep_running)
    bake.shot = shot
    return bake


def bake_on_farm(scene: bpy.types.Scene, folder: str = "") -> Path:
    """Write a farm job that bakes the active camera's range, and return its path. Raises PlgsError if this file was
    never saved, or the lift is not finished; OSError."""
    lift = lift_at(scene.plgs, folder)
    read_manifest(lift.result_path)
    return write_farm_job(scene, lift, shot_of(scene, given=scene.plgs.shot))


def export_lift(settings: PLGS_PG_settings, form: str, output: str, frames: str, folder: str = "") -> exports.Export:
    """Let an engine write a finished lift in the format ``form``, as ``frames`` see it, into the folder ``output``.
    Raises PlgsError without an engine; OSError."""
    lift = lift_at(settings, folder)
    if not output:
        raise PlgsError("folder-needed", "needs a folder", f"Export of {form}", "Choose where the files should go.")
    return exports.export(lift.path, form, absolute(output), engine_environment.usable_python(), [frames])


def make_depth_cloud(scene: bpy.types.Scene, frame: str, folder: str = "") -> exports.Export:
    """Let an engine make labelled points of what a frame's camera sees of a placed lift, and put them into the scene.
    If ``frame`` is "", use the active camera's current view. Raises PlgsError without an engine; OSError."""
    lift = lift_at(scene.plgs, folder).path
    root, python = root_of_placed(lift, scene), engine_environment.usable_python()
    if not frame and scene.camera is not None:
        named = text_of(scene.camera, "frame")  # a copy has it too
        frame = named if objects_by_key(root).get(f"frame:{named}") == scene.camera else ""
    cameras = None if frame else write_view(lift, scene)
    return exports.export(lift, "clouds", cloud_folder(lift), python, [frame], cameras=cameras, shown_in=scene.name)


def showing_lift(scene: bpy.types.Scene, folder: str = "") -> Generator[None, None, Placed | None]:
    """Put the finished lift in `folder`, else the settings' lift, into the scene, part by part. Returns where it is;
    None if the scene was deleted meanwhile. Raises PlgsError if the lift is not finished."""
    lift = lift_at(scene.plgs, folder)
    try:
        return (yield from lifts.showing_lift(scene, lift))
    except PlgsError as error:
        if not lift.is_running:
            raise
        what = "cannot be shown yet: it is still running"
        raise PlgsError("still-running", what, lift.path, "Wait until it ends.", code=ErrorCode.BUSY) from error


def log_of(settings: PLGS_PG_settings, folder: str = "") -> Path:
    """The engine's log of the lift in `folder`, else of the settings' lift. Raises PlgsError if there is none."""
    log = lift_at(settings, folder).log_path
    if not log.is_file():
        raise PlgsError("no-log", "does not exist: the engine never started", log, "Start it again.")
    return log


def lift_at(settings: PLGS_PG_settings, folder: str = "") -> LiftFolder:
    """Return the lift in `folder`, else the one that is shown. Raises PlgsError if there is none."""
    path: Path | None = absolute(folder) if folder else lifts.shown_lift(settings)
    if path is None:
        raise PlgsError("no-lift", "no lift is chosen", "Lift Folder", "Start a lift, or choose the folder of one.")
    return LiftFolder.open(path)
