"""The live preview: what the scene's active camera sees of the unfinished model.

The engine renders the view that `preview.json` in the lift folder asks for. The picture it leaves is drawn over the
camera's frame in the 3D views: no camera is touched, and nothing stays in the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.job import LiftFolder
from ...engine.job.cameras import PreviewCamera, write_preview_request
from ...engine.posed import size_within
from ..frames import camera_seen
from ..owned import tag
from ..paths import absolute

_LARGEST = (1024, 1024)
"""Width and height in pixels of the largest live preview that is asked for."""


@dataclass(frozen=True, eq=False)
class Preview:
    """A picture, float32 [H, W, 4] in sRGB, lowest row first, and the fingerprint of the camera that sees it."""

    camera: str
    pixels: NDArray[np.float32]


_asked: dict[Path, PreviewCamera] = {}
"""The camera that was asked for last, by lift folder: a file is written only when the camera changes."""
_shown: dict[Path, Preview] = {}
"""The newest picture, by lift folder."""


def follow_camera(lift: LiftFolder, scenes: Iterable[bpy.types.Scene]) -> None:
    """Ask the engine for what the active camera sees of the first of these scenes that shows this lift."""
    wanted = next((view for scene in scenes if _shows(scene, lift.path) and (view := _view_of(scene))), None)
    if wanted is None or wanted == _asked.get(lift.path):
        return
    _asked[lift.path] = wanted
    try:
        write_preview_request(lift.preview_request_path, wanted)
    except OSError:  # a lift that we may only read: its owner's preview is shown here too
        return


def show(lift: LiftFolder, picture: Path, camera: str) -> bool:
    """Keep the engine's newest picture, as seen by the camera with this fingerprint, if it is what was asked for;
    whether it is. Where another Blender asked for another one, ours asks again.
    """
    asked = _asked.get(lift.path)
    if asked is None or not picture.is_file():
        return False
    if asked.fingerprint != camera:
        del _asked[lift.path]
        return False
    pixels = _pixels_of(picture)
    if pixels is None:
        return False
    _shown[lift.path] = Preview(camera, pixels)
    return True


def picture_for(scene: bpy.types.Scene) -> NDArray[np.float32] | None:
    """The picture to draw over the frame of the scene's camera; None while there is none of what it sees now."""
    for lift, preview in _shown.items():
        view = _view_of(scene) if _shows(scene, lift) else None
        if view is not None and view.fingerprint == preview.camera:
            return preview.pixels
    return None


def forget(lift: Path | None = None) -> None:
    """Forget the previews of the lift in this folder, or of all lifts."""
    for kept in (_asked, _shown):
        for each in [lift] if lift is not None else list(kept):
            kept.pop(each, None)


def _view_of(scene: bpy.types.Scene) -> PreviewCamera | None:
    """The view of the scene's camera, None when it has none that can be drawn."""
    camera = camera_seen(scene)
    if camera is None:
        return None
    camera = camera.resized(*size_within((camera.width, camera.height), _LARGEST))
    pose = tuple(tuple(row) for row in camera.camera_to_world.tolist())
    lens = ((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0))
    return PreviewCamera(pose, lens, camera.width, camera.height)


def _shows(scene: bpy.types.Scene, lift: Path) -> bool:
    """Whether the scene's panel is set to this lift and wants to see it."""
    settings = scene.plgs
    is_set = bool(settings.live_preview and settings.lift_folder) and scene.library is None
    return is_set and absolute(settings.lift_folder) == lift


def _pixels_of(picture: Path) -> NDArray[np.float32] | None:
    """The numbers in an image file, float32 [H, W, 4]; None when the engine has just taken it away."""
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
    return pixels if pixels.size else None
