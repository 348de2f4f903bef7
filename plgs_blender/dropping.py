"""The scene or lift that a chosen or dropped file belongs to."""

from __future__ import annotations

from pathlib import Path

from ..engine.errors import PlgsError

_SCENE_FILES = (".sens", ".r3d")
"""Suffixes of files that are whole scenes."""
_PARTS = {
    "color", "depth", "pose", "intrinsic", "rgb", "image", "images", "input", "results", "panoptic", "semantic",
    "instance", "masks", "keyframes", "cameras", "corrected_cameras", "corrected_images", "corrected_depth",
    "confidence", "iphone", "rgbd", "sparse", "0", "model", "colmap", "_detail", "m2f_semantics", "m2f_instance",
}  # fmt: skip
"""Names of folders that lie inside a scene. The engine tells formats apart; this only finds the scene's folder."""
_HIGHEST = 3
"""At most this many folders up are searched: result/passes/0001.exr lies two below its lift."""


def lift_or_scene(path: Path) -> tuple[Path | None, Path | None]:
    """The lift's folder and the scene's folder or file that a file or folder belongs to, one of them None."""
    path = path.absolute()
    for folder in [path, *path.parents][: _HIGHEST + 1]:
        if (folder / "request.json").is_file():
            return folder, None
    return None, scene_at(path)


def scene_at(path: Path) -> Path:
    """The scene's folder or file that a file or folder belongs to. Raises PlgsError where nothing is there."""
    path = path.absolute()
    if not path.exists():
        raise PlgsError("there is no such file", path, "Choose the scene's folder, or a file in it.")
    if path.is_file() and path.suffix.lower() in _SCENE_FILES:
        return path
    folder = path if path.is_dir() else path.parent
    for _ in range(_HIGHEST):
        if folder.name.lower() not in _PARTS and not folder.name.startswith("scene_cam_"):
            break
        folder = folder.parent
    return folder
