"""The scene or lift that a chosen or dropped file belongs to."""

from __future__ import annotations

from pathlib import Path

from ..engine.errors import PlgsError
from ..engine.scene import FORMATS, SceneFormat

_SCENE_FILES = (".sens", ".r3d")
"""Endings of files that are scenes by themselves."""
_HIGHEST = 3
"""At most this many folders up are searched: result/passes/0001.exr lies two below its lift."""


def lift_or_scene(path: Path) -> tuple[Path | None, Path | None]:
    """The lift's folder and the scene's folder or file that a file or folder belongs to, one of them None.

    Raises PlgsError when it belongs to neither.
    """
    path = path.absolute()
    for folder in _upwards(path):
        if (folder / "request.json").is_file():
            return folder, None
    scene = _scene_of(path)
    if scene is None:
        fix = "Drop a file out of a scene (transforms.json, panoptic.json, a pose, .sens, .r3d) or out of a lift."
        raise PlgsError("belongs neither to a scene nor to a lift", path, fix)
    return None, scene


def scene_at(path: Path, scene_format: str | None = None) -> Path:
    """The scene's folder or file that a file or folder belongs to; with a format, the first that has its looks.

    A folder that nobody recognises is left to the reader, whose message says what is looked for. Raises PlgsError for a
    file that belongs to no scene.
    """
    path = path.absolute()
    scene = _scene_of(path, scene_format)
    if scene is None and path.is_dir():
        return path
    if scene is None:
        fix = "Choose the scene's folder, or a file in it such as transforms.json, .sens or .r3d."
        raise PlgsError("belongs to no scene of a known format", path, fix)
    return scene


def _scene_of(path: Path, scene_format: str | None = None) -> Path | None:
    if path.suffix.lower() in _SCENE_FILES and path.is_file():
        return path
    known = [each for each in FORMATS if scene_format in (None, each.name)]
    found = [(folder, _looks_of(folder, known)) for folder in _upwards(path) if folder.is_dir()]
    found = [(folder, looks) for folder, looks in found if looks]
    if not found:
        return None
    # The folders inside a COLMAP project look like one, too; the pictures lie beside the outermost.
    innermost, looks = found[0]
    is_model = looks == {"colmap"} and innermost.name in ("0", "sparse", "model")
    return next(folder for folder, seen in reversed(found) if seen == looks) if is_model else innermost


def _looks_of(folder: Path, known: list[SceneFormat]) -> set[str]:
    """The formats that a folder looks like; none where it cannot be looked at."""
    try:
        return {each.name for each in known if each.recognises(folder)}
    except (OSError, PlgsError):
        return set()


def _upwards(path: Path) -> list[Path]:
    return [path, *path.parents][: _HIGHEST + 1]
