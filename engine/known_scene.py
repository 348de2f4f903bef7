"""A lift's scene.json: its frames and cameras, which Blender places and bakes without the scene itself."""

from __future__ import annotations

import os
from pathlib import Path

from .errors import PlgsError
from .job import LiftFolder, write_atomically
from .posed import ClassTable, PosedScene
from .posed.scene_record import StoredScene
from .records import read_record, record_text
from .result_files import INSTANCES, read_instances

KNOWN_SCENE = "scene.json"
"""File of a lift folder: the frames of its scene with their cameras."""
FIND_SCENE = "Say where the scene is now, with Find Scene or --scene."
_FIX = "Delete this file, then let an engine bake a frame of the lift, which writes it again."


def known_scene(folder: LiftFolder, classes: ClassTable | None = None) -> PosedScene:
    """The frames of a lift with their cameras, and the classes of its result, read unless given. No pixel can be read
    from it; where the scene is gone, its pictures are not shown.

    Raises PlgsError for a lift without a list of its frames, and for a damaged one."""
    scene, known = folder.request.scene, read_known(folder)
    if known is None:
        fix = "Let an engine bake a frame of it, which writes the list."
        raise PlgsError("an early version made this lift, without a list of its frames", folder.path, fix)
    classes = classes or read_instances(folder.result_path / INSTANCES)[0]
    frames, warnings = known.posed_frames(scene), known.warnings
    if not os.path.exists(scene):
        warnings = (f"the scene is not at {scene}, so there are no photos. {FIND_SCENE}",)
    return PosedScene(scene, frames, classes, warnings, known.layout)


def read_known(folder: LiftFolder) -> StoredScene | None:
    """What a lift's scene.json holds; None without the file. Raises PlgsError for a damaged one."""
    path = folder.path / KNOWN_SCENE
    return read_record(StoredScene, path, _FIX) if path.is_file() else None


def write_known(folder: LiftFolder, known: StoredScene) -> None:
    """Write what is known of a lift's scene beside its request. Raises OSError."""
    write_atomically(folder.path / KNOWN_SCENE, record_text(known))


def has_known(lift: Path) -> bool:
    """Whether the folder of a lift has the list of its frames."""
    return (lift / KNOWN_SCENE).is_file()
