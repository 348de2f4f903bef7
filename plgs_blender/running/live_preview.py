"""What the engine sees in the unfinished model, as the background of one of our cameras.

The engine renders the view that `preview.json` in the lift folder asks for; here the scene's active camera is asked
for, and the picture shown behind (half transparent before) that camera. Only cameras that we made are dressed.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import bpy

from ...engine.job import LiftFolder
from ...engine.job.preview_request import write_preview_request
from ..owned import KEY, LIFT, tag
from ..paths import absolute
from . import lifts

_IMAGE = "live preview"
_FRAME = "frame"

_asked: dict[Path, str] = {}
"""The frame last asked for, by lift folder: so a file is written only when the camera changes."""


def can_be_seen(scene: bpy.types.Scene) -> bool:
    """Whether the scene's active camera is one of ours: only those show the preview."""
    camera = scene.camera
    return camera is not None and LIFT in camera and _FRAME in camera


def follow_camera(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> None:
    """Ask the engine for the view of the active camera of the scene that shows this lift, when it is one of ours."""
    for scene in _scenes_of(lift, scenes):
        if can_be_seen(scene) and _asked.get(lift.path) != scene.camera[_FRAME]:
            with suppress(OSError):  # somebody else's lift that we may only read: it shows what its owner asks for
                write_preview_request(lift.preview_request_path, scene.camera[_FRAME])
                _asked[lift.path] = scene.camera[_FRAME]
        return


def show(lift: LiftFolder, picture: Path, scenes: Iterable[bpy.types.Scene]) -> None:
    """Let the scene's active camera, if it is ours, show the engine's newest picture."""
    for scene in _scenes_of(lift, scenes):
        if not can_be_seen(scene) or not picture.is_file():
            return
        owner = scene.camera[LIFT]
        image = _image_of(owner)
        if image is None:
            try:
                image = _new_image(owner, picture)
            except RuntimeError:  # the engine has just taken it away: the next one will do
                return
        image.filepath = str(picture)
        image.reload()
        _dress(scene.camera.data, image)


def remove(lift: Path) -> None:
    """Take the preview of the lift in this folder away again; the photos come back."""
    _asked.pop(lift, None)
    for image in _previews():
        if absolute(image.filepath).is_relative_to(lift):
            for data in bpy.data.cameras:
                _undress(data, image)
            bpy.data.images.remove(image)


def remove_left_over() -> None:
    """Take away the previews of lifts that run no longer: of a file that was saved, or an undo step made, meanwhile."""
    running = {followed.folder.path for followed in lifts.running()}
    for path in [absolute(image.filepath) for image in _previews()]:
        if not any(path.is_relative_to(lift) for lift in running):
            remove(path.parent)


def _scenes_of(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> list[bpy.types.Scene]:
    """The scenes whose panel is set to this lift and wants to see it."""
    chosen = [scene for scene in scenes if scene.plgs.live_preview and scene.plgs.lift_folder]
    return [scene for scene in chosen if absolute(scene.plgs.lift_folder) == lift.path]


def _previews() -> list[bpy.types.Image]:
    return [image for image in bpy.data.images if image.get(KEY) == _IMAGE and image.library is None]


def _image_of(owner: str) -> bpy.types.Image | None:
    return next((image for image in _previews() if image.get(LIFT) == owner), None)


def _new_image(owner: str, picture: Path) -> bpy.types.Image:
    """Raises RuntimeError when there is no such file any more."""
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.name = "PLGS live preview"
    tag(image, owner, _IMAGE)
    return image


def _dress(data: bpy.types.Camera, image: bpy.types.Image) -> None:
    """Lay the preview, opaque, over the photo, which stays as it is."""
    if all(each.image != image for each in data.background_images):
        mine = data.background_images.new()
        mine.image, mine.display_depth, mine.alpha, mine.frame_method = image, "FRONT", 1.0, "STRETCH"
        mine.show_expanded = False


def _undress(data: bpy.types.Camera, image: bpy.types.Image) -> None:
    for each in [each for each in data.background_images if each.image == image]:
        data.background_images.remove(each)
        data.update_tag()  # else the copy that Blender draws from keeps pointing at the image, and Blender crashes
