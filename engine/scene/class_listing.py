"""The classes of a scene's masks as a list that a user edits, and the file that the edited list goes into."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..job.atomic import write_atomically
from ..json_file import read_object
from ..records import record_of
from ..scene_source import SceneSource
from .class_choice import FILE_NAME, class_choice_text, find_class_choice
from .class_map import NamedClass, choice_of, named_classes
from .masks import mask_place, no_masks, open_mask_source
from .numbering import numbered
from .opening import open_asked

_AGAIN = "Read the classes again."


@dataclass(frozen=True)
class ClassList:
    """``rows`` in order of the masks' numbers, and numbers that mean nothing (``void``).

    ``path`` is that of the classes.toml beside the masks, which may not be there yet.
    """

    path: Path
    rows: tuple[NamedClass, ...]
    void: tuple[int, ...] = ()


def list_classes(source: SceneSource, table: str | None = None) -> ClassList:
    """The classes in the masks' files and in a classes.toml beside them. Opens the scene; raises PlgsError.

    ``table`` starts again with the classes of a table (see ``TABLES``), for masks whose files have none.
    """
    path = class_list_path(source.scene, source.masks)
    scene = open_asked(replace(source, up="z", classes=table))
    place, names = _place_of_masks(source.scene, source.masks), [frame.name for frame in scene.frames]
    masks = open_mask_source(place, names, source.mask_format)
    if table is not None and masks.tells_no_class:
        fix = f"Write {FILE_NAME} beside them: [[class]] with id, name and thing for each number."
        raise PlgsError("the masks number objects and have no classes, so no table fits", place, fix)
    masks, choice, _ = numbered(masks, find_class_choice(table, path.parent), place)
    if table is not None and choice is not None:
        return ClassList(path, tuple(named_classes(choice.labels or (), None)))
    labels = masks.labels or ()
    void = () if choice is None else tuple(sorted(choice.void))
    has_any = labels or (choice is not None and (choice.rows or choice.labels))
    return ClassList(path, tuple(named_classes(labels, choice)) if has_any else (), void)


def write_class_list(source: SceneSource, edited: Path) -> Path:
    """Write the classes.toml beside a scene's masks from a ClassList that was edited, in a JSON file. Returns its path.

    The colours in it stay. Raises PlgsError for a list of another scene, and for a class without a name.
    """
    content: dict[str, Any] = read_object(edited, _AGAIN)
    listed, path = record_of(ClassList, content, edited, _AGAIN), class_list_path(source.scene, source.masks)
    if not listed.rows:
        raise PlgsError("there are no classes to write", "Classes", "Read them from the masks first.")
    if not all(row.name.isprintable() and row.name and row.into.isprintable() for row in listed.rows):
        raise PlgsError("a class has no name", "Classes", "Give each class a name of one line.")
    if listed.path.absolute() != path.absolute():
        raise PlgsError("the list is of another scene", path, _AGAIN)
    rows = [replace(row, into=row.into or row.name) for row in listed.rows]
    choice, before = choice_of(rows, frozenset(listed.void)), find_class_choice(None, path.parent)
    colours = {each: row.colour for row in (before.rows if before else ()) for each in (row.id, row.name)}
    kept = tuple(replace(row, colour=colours.get(row.id) or colours.get(row.name)) for row in choice.rows)
    write_atomically(path, class_choice_text(replace(choice, rows=kept)))
    return path


def class_list_path(folder: Path, masks: Path | None = None) -> Path:
    """The classes.toml beside a scene's masks, which may not be there yet.

    Raises PlgsError without masks, and when something else has its name.
    """
    place = _place_of_masks(folder, masks)
    beside = place if place.is_dir() else place.parent
    path = beside / FILE_NAME
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise PlgsError("this is a link or a folder, not a file", path, "Move it away.")
    find_class_choice(None, beside)
    return path


def _place_of_masks(folder: Path, masks: Path | None) -> Path:
    place = mask_place(folder if folder.is_dir() else folder.with_suffix(""), masks)
    if place is None:
        raise no_masks(folder)
    return place
