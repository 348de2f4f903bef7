"""The lifts that this Blender follows, by folder, and the live preview of a running lift through the active camera.

The engine renders the view that the lift folder's `preview.json` describes. Its picture is drawn over the camera's
frame in the 3D views: no camera is changed, and nothing stays in the file."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import ErrorCode, PlgsError
from ...engine.job import LiftFolder, LiftState
from ...engine.job.cameras import PreviewCamera, write_preview_request
from ...engine.job.events import at_work
from ...engine.job.follower import TaskFollower, start_bake
from ...engine.job.process import engine_command
from ...engine.job.recent import RecentLift, recent_lifts
from ...engine.job.task import BAKE, LIFT, TaskState
from ...engine.posed import size_within
from .. import registry
from ..cameras import camera_seen
from ..chosen_scene import absolute
from ..inspecting.selection import active_lift
from ..inspecting.views import look_at_placed
from ..lift_scene import place_passes_anew, place_room, reading_lift
from ..owned import FOLDER, Placed, is_placed, tag, text_of
from ..registry import Task
from ..settings import PLGS_PG_settings, adopt, chosen_lift
from ..shots import ShotReader
from ..startup_file import taking_over
from ..viewport import own_view
from . import exports

_LARGEST = (1024, 1024)  # largest width and height of a live preview in pixels


_asked: dict[Path, PreviewCamera] = {}
"""The last requested camera by lift folder: the request is written only if the camera changes."""
_shown: dict[Path, tuple[str, NDArray[np.float32]]] = {}
"""The newest picture by lift folder: its camera's fingerprint, and float32 [H, W, 4] in sRGB, lowest row first."""


def follow_camera(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> None:
    """Request a preview of a lift from the active camera of the first of these scenes that shows it."""
    wanted = next((view for scene in scenes if _shows(scene, lift.path) and (view := _view_of(scene))), None)
    if wanted is None or wanted == _asked.get(lift.path):
        return
    _asked[lift.path] = wanted
    try:
        write_preview_request(lift.preview_request_path, wanted)
    except OSError:  # a lift that we may only read: its owner's preview is shown here too
        return


def show(lift: LiftFolder, picture: Path, camera: str) -> bool:
    """Keep the engine's newest picture if it was rendered from the requested camera, whose fingerprint is ``camera``;
    returns whether it was. If another Blender requested another camera, request this Blender's again."""
    asked = _asked.get(lift.path)
    if asked is None or not picture.is_file():
        return False
    if asked.fingerprint != camera:
        del _asked[lift.path]
        return False
    pixels = _pixels_of(picture)
    if pixels is None:
        return False
    _shown[lift.path] = camera, pixels
    return True


def picture_for(scene: bpy.types.Scene) -> NDArray[np.float32] | None:
    """The picture, [H, W, 4], to draw over the frame of the scene's camera or of its `own_view`; None without one."""
    for lift, (camera, pixels) in _shown.items():
        view = _view_of(scene) if _shows(scene, lift) else None
        if view is not None and view.fingerprint == camera:
            return pixels
    return None


def forget(lift: Path | None = None) -> None:
    """Drop the pictures of the lift in this folder, or of all lifts."""
    for kept in (_asked, _shown):
        for each in [lift] if lift is not None else list(kept):
            kept.pop(each, None)


def _view_of(scene: bpy.types.Scene) -> PreviewCamera | None:
    """Return the camera of the scene's 3D view, or the scene's camera if the view looks through one; else None."""
    own = own_view(scene)
    camera = own[1] if own is not None else camera_seen(scene)
    if camera is None:
        return None
    camera = camera.resized(*size_within((camera.width, camera.height), _LARGEST))
    pose = tuple(tuple(row) for row in camera.camera_to_world.tolist())
    lens = ((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0))
    return PreviewCamera(pose, lens, camera.width, camera.height)


def _shows(scene: bpy.types.Scene, lift: Path) -> bool:
    """Whether the scene's panel shows this lift with a live preview."""
    settings = scene.plgs
    is_set = bool(settings.live_preview and settings.lift_folder) and scene.library is None
    return is_set and absolute(settings.lift_folder) == lift


def _pixels_of(picture: Path) -> NDArray[np.float32] | None:
    """Return an image file's pixels, float32 [H, W, 4]; None if the engine has just removed it."""
    try:
        image = bpy.data.images.load(str(picture), check_existing=False)
    except RuntimeError:
        return None
    try:
        tag(image, str(picture), "live preview")
        image.colorspace_settings.is_data = True  # its colours are drawn unchanged
        width, height = image.size
        pixels = np.empty((height, width, 4), np.float32)
        image.pixels.foreach_get(pixels.ravel())
    finally:
        bpy.data.images.remove(image, do_unlink=False)
    return pixels if pixels.size else None  # Blender gives a broken file the size 0


_SHOWN_RECENT = 8  # maximum number of recent lifts listed in the panel


class Lift(Task):
    """A lift that is followed, or a later bake of its frames, started here or elsewhere. ``lift_state`` and
    ``has_result`` are as last read: a lift that was stopped while lifting again has its earlier result. ``shot`` is
    what is baked."""

    kind, cancel_operator = "lift", "plgs.cancel_lift"
    shot: ShotReader | None = None

    def __init__(self, follower: TaskFollower, lift_state: LiftState = LiftState.RUNNING, is_new: bool = False) -> None:
        super().__init__(follower)
        assert follower.lift is not None
        self.folder: LiftFolder = follower.lift
        self.lift_folder = follower.lift.path
        self.label = f"{'Baking' if self.is_baking else 'Lifting'} {follower.lift.path.name}"
        self.lift_state, self._is_new, self._was_watched = lift_state, is_new, lift_state is LiftState.RUNNING
        self.has_result = self.folder.manifest_path.is_file()
        self._pictures_seen = 0
        self.scene_is_there = os.path.exists(follower.lift.request.scene)

    @property
    def key(self) -> Hashable:
        return self.kind, self.folder.path

    @property
    def is_baking(self) -> bool:
        """Whether this is a later bake of more frames, not the lift itself."""
        return self.follower.kind == BAKE

    @property
    def is_finished(self) -> bool:
        """Whether the lift's result is complete, even if more passes are being baked."""
        return self.lift_state is LiftState.FINISHED

    @property
    def can_be_resumed(self) -> bool:
        """Whether an engine could resume the lift."""
        return self.lift_state not in (LiftState.RUNNING, LiftState.FINISHED)

    @property
    def message(self) -> str:
        """One line for the user about the lift's success or cancellation."""
        if self.is_baking:
            return "The passes are baked" if self.state is TaskState.FINISHED else "Baking was cancelled"
        if self.is_finished:
            return "The lift is finished"
        return "The lift was not started" if self.lift_state is LiftState.NOT_STARTED else "The lift was cancelled"

    def _is_wanted(self, scene: Any) -> bool:
        """Whether a scene's panel shows this lift and wants its result."""
        return bool(scene.plgs.place_when_done) and chosen_lift(scene.plgs) == self.folder.path

    def done(self, scene: Any) -> Iterator[object]:
        """Put baked passes where the lift is shown, and a finished result into the scene, if its panel wants it."""
        try:
            self.lift_state, self.has_result = self.folder.state_at_a_glance(), self.folder.manifest_path.is_file()
        except (PlgsError, OSError):  # the folder was deleted, or its disk removed
            self.lift_state, self.has_result = LiftState.INTERRUPTED, False
        if self._is_new and self.error is not None and self.folder.came_to_nothing():
            self.folder.discard()  # so that the lift can be started again once the scene is fixed
        if self.shot is not None:
            self.shot.withdraw_unbaked(self.follower)
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
        """Update the live preview of the lift in these scenes. Returns whether 3D views need redrawing."""
        if not self.is_running:
            forget(self.folder.path)
            return True
        follow_camera(self.folder, scenes)
        progress, before = self.progress, self._pictures_seen
        self._pictures_seen = progress.live_previews
        if progress.live_preview is None or before == progress.live_previews:
            return False
        return show(self.folder, progress.live_preview, progress.live_preview_camera)

    def let_go(self) -> None:
        """End our own engine within a second, unless it should outlive Blender. The lift can be resumed."""
        self.follower.close()


refusals: dict[Path, PlgsError | OSError | ValueError] = {}
"""Why the lift in a folder could not be read."""
nothing_there: set[Path] = set()
"""The chosen folders that did not exist when they were chosen."""
recent: list[RecentLift] = []
"""The recent lifts as of the last `refresh_recent`, newest first."""


def lift_of(folder: Path) -> Lift | None:
    """Return the followed lift in this folder (absolute); None if it is not followed."""
    task = registry.task_of((Lift.kind, folder))
    return task if isinstance(task, Lift) else None


def stops_with_blender(scene: Any) -> bool:
    """Whether a lift is running that ends when Blender quits."""
    return not scene.plgs.keep_running and any(each.follower.is_own for each in registry.running(Lift))


def refresh_recent() -> None:
    """Read the user's list of lifts, which takes some milliseconds."""
    recent[:] = recent_lifts(most=_SHOWN_RECENT)


def start(lift: LiftFolder, python: Path, *, resume: bool = False, keep_running: bool = False) -> Lift:
    """Start an engine on a lift folder and follow it. With ``keep_running`` it outlives this Blender. Raises OSError,
    and PlgsError if an engine is already at work there or does not start."""
    _refuse_running(lift)
    command = engine_command(python, lift.path, resume=resume)
    started = TaskFollower.start(command, lift.task_files, kind=LIFT, lift=lift, stays_with_parent=not keep_running)
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
    """Let an engine bake more passes of a finished lift: of frames ("test", "all", or names), or of the ``cameras`` in
    a file, with these FURTHER_LAYERS. Other Blenders may bake it, too. Raises PlgsError until this one's last bake has
    ended; OSError."""
    known = lift_of(lift.path)
    if known is not None and known.is_running and known.follower.is_own:
        what, fix = "this Blender is already baking or lifting here", "Wait for it, or cancel it first."
        raise PlgsError("blender-busy", what, lift.path, fix, code=ErrorCode.BUSY)
    if known is not None and known.is_being_taken:
        raise PlgsError("being-placed", "is being placed in Blender", lift.path, "Wait a moment.", code=ErrorCode.BUSY)
    if not lift.manifest_path.is_file():
        _refuse_running(lift)
    ties = not keep_running
    return _follow(Lift(start_bake(lift, python, frames, cameras=cameras, layers=layers, stays_with_parent=ties)))


def attach(folder: Path) -> Lift:
    """Follow a lift that was started elsewhere, or show one that has ended. Raises PlgsError for any other folder."""
    known = lift_of(folder)
    if known is not None and known.is_running:
        return known
    lift = LiftFolder.open(folder)
    state = lift.state()
    task = Lift(TaskFollower(lift.task_files, lift=lift), state)
    if state is not LiftState.RUNNING:  # nobody asked for its result yet
        task.is_taken = True
        if state is LiftState.NOT_STARTED:
            task.follower.state = TaskState.CANCELLED
        else:
            while task.follower.poll() and task.is_running:
                pass  # read up to its last event, so that it does not look as if it ran
    return _follow(task)


def shown_lift(settings: PLGS_PG_settings) -> Path | None:
    """Return the folder of the panel's lift, else of the lift that the settings' scene shows, else None."""
    root = active_lift(settings.id_data, None)
    placed = "" if root is None else text_of(root, FOLDER)
    return chosen_lift(settings) or (absolute(placed) if placed else None)


def look_at(folder: Path) -> Lift | None:
    """Follow the lift in a folder and return it; None without a lift, or if `refusals` now says what is wrong."""
    known = lift_of(folder)
    if known is not None:
        return known
    refusals.pop(folder, None)
    nothing_there.discard(folder)
    try:
        if folder.exists():
            return attach(folder)
        nothing_there.add(folder)
        return None
    except (PlgsError, OSError, ValueError) as error:  # ValueError: this system has no such path
        refusals[folder] = error
        return None


def showing_lift(
    scene: Any, lift: LiftFolder, is_wanted: Callable[[Any], bool] = lambda scene: True
) -> Generator[None, None, Placed | None]:
    """Put a finished lift into the scene, copy its options to the panel and point the 3D views at it, in parts, so that
    the window does not freeze. Returns where it is; None if, once the lift is read, the scene is gone or `is_wanted` is
    false for it. Raises PlgsError if the lift is unfinished or damaged."""
    name = scene.name
    read = yield from reading_lift(lift.path)
    scene = bpy.data.scenes.get(name)  # undo may have put another one in its place
    if scene is None or not is_wanted(scene):
        return None
    with taking_over(scene):
        placed, rest = place_room(read, scene)
    adopt(scene.plgs, lift.request, lift.path)
    yield
    next(rest, None)  # the lists, without which `look_at_placed` does nothing
    yield
    found = placed.find()
    if found is not None:
        look_at_placed(*found)
    yield
    yield from rest
    return placed


def _refuse_running(lift: LiftFolder) -> None:
    if lift.is_running:
        raise at_work(lift.events_path)


def _follow(task: Lift) -> Lift:
    refusals.pop(task.folder.path, None)
    return registry.begin(task)
