"""What the engine sees in the unfinished model, from the scene's active camera, whoever made it.

The engine renders the view that `preview.json` in the lift folder asks for. The picture it leaves is drawn over the
camera's frame in the 3D views: no camera is touched. Blender reads it through an image that nothing in the file uses.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.job import LiftFolder
from ...engine.job.preview_request import PreviewCamera, write_preview_request
from ...engine.scene import Camera
from ..frames import camera_seen
from ..owned import KEY, LIFT, tag
from ..paths import absolute
from . import lifts

_IMAGE = "live preview"


@dataclass(frozen=True)
class Preview:
    """A picture, float32 [H, W, 4] in sRGB, lowest row first, and the camera that was asked for when it came."""

    camera: PreviewCamera
    pixels: NDArray[np.float32]



_asked: dict[Path, PreviewCamera] = {}
"""The camera last asked for, by lift folder: so a file is written only when the camera changes."""
_shown: dict[Path, Preview] = {}
"""The newest picture, by lift folder."""


def follow_camera(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> None:
    """Ask the engine for the view of the active camera of the scene that shows this lift."""
    for scene in _scenes_of(lift.path, scenes):
        wanted = _view_of(scene)
        if wanted is not None and wanted != _asked.get(lift.path):
            with suppress(OSError):  # somebody else's lift that we may only read: it shows what its owner asks for
                write_preview_request(lift.preview_request_path, wanted)
                _asked[lift.path] = wanted
        return


def show(lift: LiftFolder, picture: Path, scenes: Iterable[bpy.types.Scene]) -> None:
    """Let the engine's newest picture be seen, where a scene wants to see this lift."""
    if lift.path not in _asked or not picture.is_file() or not _scenes_of(lift.path, scenes):
        return
    image = _image_of(lift.path)
    if image is None:
        try:
            image = _new_image(lift.path, picture)
        except RuntimeError:  # the engine has just taken it away: the next one will do
            return
    image.reload()
    width, height = image.size
    pixels = np.empty((height, width, 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    image.buffers_free()
    if pixels.size:  # else the engine has just taken it away
        _shown[lift.path] = Preview(_asked[lift.path], pixels)


def picture_for(scene: bpy.types.Scene) -> NDArray[np.float32] | None:
    """The picture to draw over the frame of the scene's camera; None while there is none of what it sees now."""
    for lift, preview in _shown.items():
        if _scenes_of(lift, [scene]) and _view_of(scene) == preview.camera:
            return preview.pixels
    return None


def remove(lift: Path) -> None:
    """Take the preview of the lift in this folder away again."""
    _asked.pop(lift, None)
    _shown.pop(lift, None)
    for image in [each for each in _previews() if each[LIFT] == str(lift)]:
        bpy.data.images.remove(image)


def remove_left_over() -> None:
    """Take away the previews of lifts that run no longer: an undo step or a file that was saved may have kept one."""
    running = {str(followed.folder.path) for followed in lifts.running()}
    for lift in {image[LIFT] for image in _previews()} - running:
        remove(Path(lift))


def _view_of(scene: bpy.types.Scene) -> PreviewCamera | None:
    """What the scene's camera sees, in plain numbers."""
    camera = camera_seen(scene)
    return None if camera is None else _plain(camera)


def _plain(camera: Camera) -> PreviewCamera:
    pose = tuple(tuple(row) for row in camera.camera_to_world.tolist())
    lens = ((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0))
    return PreviewCamera(pose, lens, camera.width, camera.height)


def _scenes_of(lift: Path, scenes: Iterable[bpy.types.Scene]) -> list[bpy.types.Scene]:
    """The scenes whose panel is set to this lift and wants to see it."""
    chosen = [scene for scene in scenes if scene.plgs.live_preview and scene.plgs.lift_folder]
    return [scene for scene in chosen if absolute(scene.plgs.lift_folder) == lift]


def _previews() -> list[bpy.types.Image]:
    return [image for image in bpy.data.images if image.get(KEY) == _IMAGE and image.library is None]


def _image_of(lift: Path) -> bpy.types.Image | None:
    return next((image for image in _previews() if image.get(LIFT) == str(lift)), None)


def _new_image(lift: Path, picture: Path) -> bpy.types.Image:
    """Raises RuntimeError when there is no such file any more."""
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.name = "PLGS live preview"
    image.colorspace_settings.name = "Non-Color"  # the numbers in the file: the view's colour management comes before
    tag(image, str(lift), _IMAGE)
    return image
