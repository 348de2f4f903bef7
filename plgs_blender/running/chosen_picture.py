"""One choice of photo, depth or masks for all frames of an import or a lift.

The picture of a frame is made when its camera has been the scene's for a moment, and neither an animation plays nor a
render runs: so scrubbing is not held up, and a render shows what it began with.
"""

from __future__ import annotations

import bpy

from ...engine.errors import PlgsError
from ..frame_pictures import root_of, why_no_picture
from ..frames import PHOTO, SHOWN
from ..owned import text_of
from ..tasks import registry
from .importing import FrameMaking, show_picture

_CHOSEN = "plgs_picture"
"""Property of an import's or a lift's collection: what was chosen to be in front of its cameras' views."""
_REST_S = 0.4
"""Seconds for which a camera must stay the scene's."""
_tried: list[tuple[str, str]] = []
"""The camera and the picture that was asked for last: what an engine cannot make is not asked for again."""


def choose_picture(scene: bpy.types.Scene, kind: str, *, asked: bool = True) -> FrameMaking | None:
    """Show this picture in front of the view of the active camera, and of each that becomes the active one later. If
    that takes an engine, its task is returned. It adds an undo step where a user ``asked``. Raises PlgsError, OSError.
    """
    making = show_picture(scene, kind, asked=asked)
    root_of(scene, scene.camera)[_CHOSEN] = kind
    _tried[:] = [(scene.camera.name, kind)]
    return making


def wanted(scene: bpy.types.Scene) -> str:
    """The picture that the scene's camera should show and does not; empty when all is as it was chosen."""
    if why_no_picture(scene) is not None:
        return ""
    try:
        kind = text_of(root_of(scene, scene.camera), _CHOSEN)
    except PlgsError:  # a camera without its collection shows what it shows
        return ""
    is_tried = (scene.camera.name, kind) in _tried
    return "" if is_tried or kind == scene.camera.get(SHOWN, PHOTO) else kind


def catch_up() -> float | None:
    """Show what the camera should show. Returns the seconds to wait while an engine makes another picture, an animation
    plays or a render runs.
    """
    scene = bpy.context.scene
    kind = wanted(scene)
    if not kind:
        return None
    if registry.running(FrameMaking) or _is_moving():
        return _REST_S
    try:
        choose_picture(scene, kind, asked=False)
    except (PlgsError, OSError):  # the panel's buttons say what the camera shows, and a press says why
        root_of(scene, scene.camera)[_CHOSEN] = text_of(scene.camera, SHOWN) or PHOTO
    return None


@bpy.app.handlers.persistent
def _on_change(scene: bpy.types.Scene, *_arguments: object) -> None:
    if bpy.app.is_job_running("RENDER") or not wanted(scene):
        return
    if bpy.app.timers.is_registered(catch_up):
        bpy.app.timers.unregister(catch_up)
    bpy.app.timers.register(catch_up, first_interval=_REST_S)


def _is_moving() -> bool:
    """Whether a render or an animation changes the frame."""
    windows = bpy.context.window_manager.windows
    return bpy.app.is_job_running("RENDER") or any(window.screen.is_animation_playing for window in windows)


def register() -> None:
    if not bpy.app.background:
        bpy.app.handlers.depsgraph_update_post.append(_on_change)
        bpy.app.handlers.frame_change_post.append(_on_change)


def unregister() -> None:
    for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.frame_change_post):
        if _on_change in handlers:
            handlers.remove(_on_change)
    if bpy.app.timers.is_registered(catch_up):
        bpy.app.timers.unregister(catch_up)
    _tried.clear()
