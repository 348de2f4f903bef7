"""Keep a saved project whole when it is moved: our paths in a .blend are relative wherever Blender's own are, and a
lift that was moved alone is bound to the collection that shows it. Blender makes all of its paths relative when a file
is saved for the first time, and updates them when it is saved elsewhere. It does not know about custom properties and
our settings, so handlers here do the same for those."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import bpy

from ..engine.errors import PlgsError
from ..engine.job import LiftFolder
from ..engine.known_scene import known_scene
from .chosen_scene import absolute
from .corrections import look_for_changes
from .owned import FOLDER, LIFT, PLACE, SCENE, folder_of, gone, key_of, lifts_in, shows, text_of
from .settings import PATHS, unheard

_before: list[tuple[Callable[[str], object], str]] = []
"""What the last save changed: how to set each path, and its value before."""


def relate(blend: Path) -> None:
    """Make our paths relative to a .blend that is about to be saved. Paths on another drive stay absolute."""
    now = Path(bpy.data.filepath)
    is_kept_absolute = bool(bpy.data.filepath) and not bpy.context.preferences.filepaths.use_relative_paths
    for store, path in _stored_paths():
        is_related = path.startswith("//")
        if is_related and not bpy.data.filepath:  # relative by an earlier call; an unsaved file has no folder
            continue
        if is_related or not is_kept_absolute:
            _change(store, path, _relative(str(absolute(path)), blend.parent))
    if now.parent == blend.parent and not is_kept_absolute:  # otherwise Blender changes them itself
        for image in bpy.data.images:
            if text_of(image, LIFT) and image.library is None and image.filepath and not image.packed_file:
                _change(partial(setattr, image, "filepath_raw"), image.filepath, _relative(image.filepath, now.parent))


def _change(store: Callable[[str], object], before: str, after: str) -> None:
    if after != before:
        _before.append((store, before))
        store(after)


def _relative(path: str, base: Path) -> str:
    if path.startswith("//"):
        return path
    try:
        return str(bpy.path.relpath(path, start=str(base)))
    except ValueError:  # another drive
        return path


def _stored_paths() -> Iterator[tuple[Callable[[str], object], str]]:
    """Yields each path in our own properties, which Blender does not know to be paths, and how to set it."""
    for scene in bpy.data.scenes:
        if scene.library is not None:
            continue
        settings = getattr(scene, "plgs", None)  # None while the extension is off
        yield from _paths_of(partial(_set_silently, settings), {name: getattr(settings, name, "") for name in PATHS})
        for root in lifts_in(scene):
            if root.library is None and root.override_library is None:
                yield from _paths_of(root.__setitem__, {name: text_of(root, name) for name in (FOLDER, SCENE)})
                place = root.get(PLACE)
                yield from () if place is None else _paths_of(place.__setitem__, place.to_dict())


def _set_silently(settings: Any, name: str, path: str) -> None:
    with unheard():
        setattr(settings, name, path)


def _paths_of(
    store: Callable[[str, str], object], values: dict[str, str]
) -> Iterator[tuple[Callable[[str], object], str]]:
    for name, value in values.items():
        is_word = name in ("format", "mask_format", "up") or (name.startswith("classes") and ".toml" not in value)
        if value and not is_word:
            yield partial(store, name), value


@bpy.app.handlers.persistent
def _before_saving(blend: str, *_: object) -> None:
    _before.clear()
    if blend:  # empty for the startup file
        relate(Path(blend).absolute())


@bpy.app.handlers.persistent
def _after_saving(blend: str, *_: object) -> None:
    """Restore the paths that `relate` changed if the open file stayed where it was: saving failed, or made a copy."""
    if not blend or Path(bpy.data.filepath).parent != Path(blend).absolute().parent:
        for store, before in _before:
            store(before)
    _before.clear()


@bpy.app.handlers.persistent
def _after_failing(*_: object) -> None:
    _after_saving("")


def bind(root: bpy.types.Collection, folder: Path) -> None:
    """Bind a placed lift to the folder to which it was moved, and also its scene and its pictures. Nothing is placed
    again. Raises PlgsError if the folder does not hold the lift that is shown."""
    lift = LiftFolder.open(folder)
    if not shows(root, lift.path):
        fix = "Choose the folder of the lift that is shown, or open this one with Open Lift."
        raise PlgsError("another-lift", "is another lift than the one that is shown", lift.path, fix)
    scene = known_scene(lift).folder
    moved = [(folder_of(root), lift.path)]
    if text_of(root, SCENE):
        before = absolute(text_of(root, SCENE))
        moved += [(before, scene), (before.parent, scene.parent)]
    for image in bpy.data.images:
        if key_of(image, root[LIFT]) is None or not image.filepath or (old := absolute(image.filepath)).is_file():
            continue
        homes = [(was, now) for was, now in moved if old.is_relative_to(was)]
        there = [new for was, now in homes if (new := now / old.relative_to(was)).is_file()]
        if there:
            image.filepath = str(there[0])
    gone.discard(root[LIFT])
    root[FOLDER], root[SCENE] = str(lift.path), str(scene)
    with suppress(OSError):
        look_for_changes(root)


HANDLERS = (("save_pre", _before_saving), ("save_post", _after_saving), ("save_post_fail", _after_failing))
