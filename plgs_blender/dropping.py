"""Finding out what a file that was dropped on the window belongs to: a scene to lift, or a lift."""

from __future__ import annotations

from pathlib import Path

from ..engine.job import JobError

_SCENE_FOLDERS = ("color", "depth", "pose", "intrinsic")
_HIGHEST = 3
"""So many folders up is looked: color/0001.jpg lies one below its scene, result/passes/0001.exr two below its lift."""


def lift_or_scene(path: Path) -> tuple[Path | None, Path | None]:
    """The lift's folder and the scene's that a file or folder belongs to, one of them None.

    Raises JobError when it belongs to neither.
    """
    path = path.absolute()
    for folder in [path, *path.parents][: _HIGHEST + 1]:
        if (folder / "request.json").is_file():
            return folder, None
        if all((folder / name).is_dir() for name in _SCENE_FOLDERS):
            return None, folder
    fix = f"Drop a file out of a scene (a folder with {', '.join(_SCENE_FOLDERS)}) or out of a lift."
    raise JobError("belongs neither to a scene nor to a lift", path, fix)
