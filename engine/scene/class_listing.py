"""The classes of a scene's masks as a list that a user edits, and the file that the edited list goes into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from .class_choice import FILE_NAME, class_choice_text, find_class_choice
from .class_map import NamedClass, choice_of, named_classes
from .class_tables import known_table
from .masks import mask_place, no_masks, open_mask_source
from .opening import open_scene


@dataclass(frozen=True)
class ClassList:
    """``rows`` in order of the masks' numbers, and numbers that mean nothing (``void``).

    ``path`` is that of the classes.toml beside the masks, which may not be there yet.
    """

    path: Path
    rows: tuple[NamedClass, ...]
    void: frozenset[int] = frozenset()


def list_classes(
    folder: Path, masks: Path | None = None, scene_format: str | None = None, table: str | None = None
) -> ClassList:
    """The classes in the masks' files and in a classes.toml beside them. Opens the scene; raises PlgsError.

    ``table`` starts anew with the classes of a table (see ``TABLES``), for masks whose files have none.
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
    """The classes.toml beside a scene's masks, which may not be there yet.

    Raises PlgsError without masks, and when something else has its name.
    """
    place = _place_of_masks(folder, masks)
    beside = place if place.is_dir() else place.parent
    path = beside / FILE_NAME
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise PlgsError("this is not a file of its own", path, "Move it away.")
    find_class_choice(None, beside)
    return path


def _place_of_masks(folder: Path, masks: Path | None) -> Path:
    place = mask_place(folder if folder.is_dir() else folder.with_suffix(""), masks)
    if place is None:
        raise no_masks(folder)
    return place


def class_list_text(rows: Sequence[NamedClass], void: frozenset[int] = frozenset()) -> str:
    """The text of a classes.toml with the edited list."""
    return class_choice_text(choice_of(rows, void))
