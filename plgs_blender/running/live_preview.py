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
            _asked[lift.path] = scene.camera[_FRAME]
            with suppress(OSError):  # somebody else's lift that we may only read: it shows what its owner asks for
                write_preview_request(lift.preview_request_path, scene.camera[_FRAME])
        return


def show(lift: LiftFolder, picture: Path, scenes: Iterable[bpy.types.Scene]) -> None:
    """Let the scene's active camera, if it is ours, show the engine's newest picture."""
    for scene in _scenes_of(lift, scenes):
        if not can_be_seen(scene) or not picture.is_file():
            return
        owner = scene.camera[LIFT]
        image = _image_of(owner) or _new_image(owner, picture)
        image.filepath = str(picture)
        image.reload()
        _dress(scene.camera.data, image)


def remove(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> None:
    """Take the preview away again; the photos come back."""
    _asked.pop(lift.path, None)
    for image in [image for image in bpy.data.images if image.get(KEY) == _IMAGE]:
        if Path(bpy.path.abspath(image.filepath)).is_relative_to(lift.path):
            for data in bpy.data.cameras:
                _undress(data, image)
            bpy.data.images.remove(image)


def _scenes_of(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> list[bpy.types.Scene]:
    """The scenes whose panel is set to this lift and wants to see it."""
    chosen = [scene for scene in scenes if scene.plgs.live_preview and scene.plgs.lift_folder]
    return [scene for scene in chosen if absolute(scene.plgs.lift_folder) == lift.path]


def _image_of(owner: str) -> bpy.types.Image | None:
    return next((im for im in bpy.data.images if im.get(LIFT) == owner and im.get(KEY) == _IMAGE), None)


def _new_image(owner: str, picture: Path) -> bpy.types.Image:
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.name = "PLGS live preview"
    tag(image, owner, _IMAGE)
    return image


def _dress(data: bpy.types.Camera, image: bpy.types.Image) -> None:
    """Show the preview alone: the photo would shine through."""
    backgrounds = data.background_images
    mine = next((each for each in backgrounds if each.image == image), None)
    if mine is None:
        mine = backgrounds.new()
        mine.image, mine.display_depth, mine.alpha, mine.frame_method = image, "FRONT", 1.0, "STRETCH"
    for each in backgrounds:
        each.show_background_image = each == mine


def _undress(data: bpy.types.Camera, image: bpy.types.Image) -> None:
    mine = next((each for each in data.background_images if each.image == image), None)
    if mine is not None:
        data.background_images.remove(mine)
        for each in data.background_images:
            each.show_background_image = True
