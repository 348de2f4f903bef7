"""The classes of a scene's masks as a list that a user edits, and the file that the edited list goes into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .class_choice import FILE_NAME, class_choice_text, find_class_choice
from .class_map import NamedClass, choice_of, named_classes
from .class_tables import known_table
from .frame import SceneError
from .mask_set import READ_FIX
from .masks import mask_place, open_mask_source
from .opening import open_scene


@dataclass(frozen=True)
class ClassList:
    """``rows`` in order of the masks' numbers; ``path`` of the classes.toml beside them, which may not be there yet;
    ``void``: numbers that mean nothing."""

    path: Path
    rows: tuple[NamedClass, ...]
    void: frozenset[int] = frozenset()


def list_classes(
    folder: Path, masks: Path | None = None, scene_format: str | None = None, table: str | None = None
) -> ClassList:
    """The classes as the masks' files and a classes.toml beside them have it. ``table`` begins anew with the classes of
    a table (see ``TABLES``), for masks whose files do not tell. Opens the scene; raises SceneError.
    """
    scene = open_scene(folder, masks, "z", scene_format, classes=table)
    place = _place_of_masks(folder, masks)
    path = class_list_path(folder, masks)
    beside = path.parent
    if table is not None:
        return ClassList(path, tuple(named_classes(known_table(table).labels, None)))
    choice = find_class_choice(None, beside)
    labels = open_mask_source(place, [frame.name for frame in scene.frames]).labels or ()
    void = frozenset[int]() if choice is None else choice.void
    has_any = labels or (choice is not None and (choice.rows or choice.labels))
    return ClassList(path, tuple(named_classes(labels, choice)) if has_any else (), void)


def class_list_path(folder: Path, masks: Path | None = None) -> Path:
    """The classes.toml beside a scene's masks, which may not be there yet. Raises SceneError where there are no masks,
    and where something lies there that is no list of classes.
    """
    place = _place_of_masks(folder, masks)
    beside = place if place.is_dir() else place.parent
    path = beside / FILE_NAME
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise SceneError("this is not a file of its own", path, "Move it away.")
    find_class_choice(None, beside)
    return path


def _place_of_masks(folder: Path, masks: Path | None) -> Path:
    place = mask_place(folder if folder.is_dir() else folder.with_suffix(""), masks)
    if place is None:
        raise SceneError("there are no masks", folder, READ_FIX)
    return place


def class_list_text(rows: Sequence[NamedClass], void: frozenset[int] = frozenset()) -> str:
    """The text of the classes.toml that says the edited list."""
    return class_choice_text(choice_of(rows, void))
