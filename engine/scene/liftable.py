"""What a lift needs beside cameras and pictures."""

from __future__ import annotations

from .frame import Scene, SceneError
from .mask_set import READ_FIX
from .opening import AskedScene, open_asked

_DEPTH_FIX = "Give depth images in the scene, or a folder of depth maps with --depth."


def require_liftable(scene: Scene) -> None:
    """Raise SceneError, with what to do about it, when a scene has no masks or no depth."""
    if not scene.has_depth:
        raise SceneError("the scene has no depth", scene.folder, _DEPTH_FIX)
    if not scene.has_masks:
        raise SceneError("there are no masks", scene.folder, READ_FIX)


def open_scene_to_lift(asked: AskedScene) -> Scene:
    """``open_asked`` for a lift. Raises SceneError also when masks or depth are missing."""
    scene = open_asked(asked)
    require_liftable(scene)
    return scene
