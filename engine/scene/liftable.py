"""What a lift needs beside cameras and pictures."""

from __future__ import annotations

from pathlib import Path

from .frame import Scene, SceneError
from .mask_set import READ_FIX
from .matrices import UpAxis
from .opening import open_scene

_DEPTH_FIX = "Give depth images in the scene, or a folder of depth maps with --depth."


def require_liftable(scene: Scene) -> None:
    """Raise SceneError, with what to do about it, when a scene has no masks or no depth."""
    if not scene.has_depth:
        raise SceneError("the scene has no depth", scene.folder, _DEPTH_FIX)
    if not scene.has_masks:
        raise SceneError("there are no masks", scene.folder, READ_FIX)


def open_scene_to_lift(
    folder: Path,
    masks: Path | None = None,
    up: UpAxis = "z",
    scene_format: str | None = None,
    depth: Path | None = None,
    mask_format: str | None = None,
    classes: str | None = None,
) -> Scene:
    """``open_scene`` for a lift. Raises SceneError also when masks or depth are missing."""
    scene = open_scene(folder, masks, up, scene_format, depth, mask_format, classes)
    require_liftable(scene)
    return scene
