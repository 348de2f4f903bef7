"""The scenes that a command line names: ``SCENE`` or ``SCENE:up=y``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path

from engine.errors import PlgsError
from engine.scene_source import UP_OPTIONS, UpAxis

_SCENE = re.compile(r"(?P<folder>.+?)(?::up=(?P<up>.*))?", re.DOTALL)
_NAME = re.compile(r"\w[\w .+-]*")
"""A name becomes part of a folder's name, and a cell of a Markdown table."""


@dataclass(frozen=True)
class SceneToLift:
    """A scene's folder (absolute), the axis of its poses that points up, and what tables call it."""

    name: str
    folder: Path
    up: UpAxis = "z"


def scenes_from(texts: Sequence[str], names: Sequence[str] | None = None) -> tuple[SceneToLift, ...]:
    """The scenes of ``texts``, each ``SCENE`` or ``SCENE:up=AXIS``, called ``names`` or as their folders are. SCENE may
    be a pattern of folders, such as ``scans/scene*``, which stands for all of them in the order of their names.

    Raises PlgsError when an axis or a name is invalid, when two names are the same, or when the numbers differ.
    """
    texts = [each for text in texts for each in _matching(text)]
    if names is not None and len(names) != len(texts):
        what = f"{len(names)} names for {len(texts)} scenes"
        raise PlgsError("unequal-counts", what, ",".join(names), "Give a name for each scene.")
    scenes = [_scene(text) for text in texts]
    if names is not None:
        scenes = [SceneToLift(name, scene.folder, scene.up) for name, scene in zip(names, scenes, strict=True)]
    known: set[str] = set()
    for scene in scenes:
        if not _NAME.fullmatch(scene.name):
            fix = "Give names of letters, digits and - with --names."
            raise PlgsError("scene-unnamable", f"{scene.name!r} cannot be a scene's name", scene.folder, fix)
        if scene.name.casefold() in known:  # on some disks Office and office are the same folder
            what = f"two scenes are called {scene.name}"
            raise PlgsError("names-clash", what, scene.folder, "Give other names with --names.")
        known.add(scene.name.casefold())
    return tuple(scenes)


def _matching(text: str) -> list[str]:
    """The scenes that a text means. Raises PlgsError for a pattern that matches no folder."""
    match = _SCENE.fullmatch(text)
    if match is None or not has_magic(match["folder"]) or Path(match["folder"]).exists():
        return [text]
    axis = text[len(match["folder"]) :]
    found = sorted(folder for folder in glob(match["folder"]) if Path(folder).is_dir())
    if not found:
        what = "no folder matches the pattern"
        raise PlgsError("no-match", what, text, "Name folders of scenes, or another pattern.")
    return [folder + axis for folder in found]


def _scene(text: str) -> SceneToLift:
    match = _SCENE.fullmatch(text)
    if match is None:
        raise PlgsError("not-scene", "is not a scene", repr(text), "Give the scene's folder.")
    up = match["up"] if match["up"] is not None else "auto"
    if up not in UP_OPTIONS:
        fix = f"Write SCENE:up= and one of {', '.join(UP_OPTIONS)}."
        raise PlgsError("not-axis", f"{up!r} is not an axis that can point up", text, fix)
    folder = Path(match["folder"]).resolve()
    return SceneToLift(folder.name, folder, UP_OPTIONS[up])
