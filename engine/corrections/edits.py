"""One edit: what it does, when it was made, and what it refers to. Its form in corrections.json.

A label is one number for class and object together: the object's id, or minus the class where there is no object (0 is
unknown).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

from ..errors import PlgsError
from ..gates import one_line
from ..json_file import Json, take_list, take_number, take_objects, take_text, take_whole_number, wrong_type

CORRECTIONS = "corrections.json"
KINDS = ("rename", "reclass", "merge", "delete", "split", "assign", "accept")
"""What this version knows. Edits of other kinds are kept, and not applied."""
MOVES = ("delete", "split", "assign")
"""Those that give points other labels."""
PER_METRE = 1000
"""Points are kept in millimetres."""
_FARTHEST = 10**9
"""Millimetres, at most."""


@dataclass(frozen=True)
class ObjectMark:
    """An object as it was when it was edited, to be known again in another lift: its id, its number of points, and the
    corners of their upright box in metres (without the outermost points)."""

    id: int
    points: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class NewObject:
    """An object that an edit makes."""

    id: int
    name: str
    class_id: int


@dataclass(frozen=True)
class MovedPoints:
    """Points that get a label. ``millimetres``: x, y and z of each in turns."""

    label: int
    millimetres: tuple[int, ...]


@dataclass(frozen=True)
class Edit:
    """One edit. What is not of its ``kind`` is empty.

    ``name`` of a rename, ``class_id`` of a reclass, and of a split whose first part is of another class than the whole.
    A merge makes all ``objects`` the first. A move takes points of the ``objects`` and of the stuff ``classes`` to
    other labels (``moved``); ``rest`` is the label of the objects' other points, None where they stay. ``raw`` is the
    entry as it was read, for kinds that this version does not know.
    """

    kind: str
    objects: tuple[ObjectMark, ...] = ()
    name: str = ""
    class_id: int = 0
    classes: tuple[int, ...] = ()
    moved: tuple[MovedPoints, ...] = ()
    made: tuple[NewObject, ...] = ()
    rest: int | None = None
    undone: bool = False
    uid: str = field(default_factory=lambda: uuid4().hex)
    time: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    raw: Mapping[str, Json] | None = None

    @property
    def largest_id(self) -> int:
        """Of the objects that it speaks of."""
        return max([*(mark.id for mark in self.objects), *(new.id for new in self.made)], default=0)

    def to_json(self) -> dict[str, Any]:
        if self.raw is not None:
            return {**self.raw, "undone": self.undone}
        marks = [{"id": m.id, "points": m.points, "low": m.low, "high": m.high} for m in self.objects]
        made = [{"id": new.id, "name": new.name, "class_id": new.class_id} for new in self.made]
        moved = [{"label": each.label, "millimetres": each.millimetres} for each in self.moved]
        given = {"name": self.name, "class_id": self.class_id, "classes": self.classes, "moved": moved, "made": made}
        entry: dict[str, Any] = {"uid": self.uid, "time": self.time, "kind": self.kind, "objects": marks}
        entry |= {key: value for key, value in given.items() if value}
        if self.rest is not None:
            entry["rest"] = self.rest
        return entry | ({"undone": True} if self.undone else {})


def edit_of(entry: dict[str, Any], path: Path) -> Edit:
    """The edit of an entry. Raises PlgsError when it is damaged."""
    kind = _line(entry, "kind", "an edit", path)
    uid, time = take_text(entry, "uid", kind, path), _line(entry, "time", kind, path)
    undone = entry.get("undone") is True
    if kind not in KINDS:
        return Edit(kind, undone=undone, uid=uid, time=time, raw=entry)
    rest = take_whole_number(entry, "rest", kind, path) if "rest" in entry else None
    moved = _optional(entry, "moved", kind, path)
    return Edit(
        kind,
        tuple(_mark(each, kind, path) for each in _optional(entry, "objects", kind, path)),
        _line(entry, "name", kind, path) if "name" in entry else "",
        take_whole_number(entry, "class_id", kind, path) if "class_id" in entry else 0,
        _whole_numbers(entry, "classes", kind, path) if "classes" in entry else (),
        tuple(_moved(each, kind, path) for each in moved),
        tuple(_made(each, kind, path) for each in _optional(entry, "made", kind, path)),
        rest,
        undone,
        uid,
        time,
    )


def _optional(entry: dict[str, Any], key: str, context: str, path: Path) -> list[dict[str, Any]]:
    return take_objects(entry, key, context, path) if key in entry else []


def _mark(entry: dict[str, Any], kind: str, path: Path) -> ObjectMark:
    points = take_whole_number(entry, "points", kind, path)
    return ObjectMark(
        _id(entry, kind, path), points, _corner(entry, "low", kind, path), _corner(entry, "high", kind, path)
    )


def _made(entry: dict[str, Any], kind: str, path: Path) -> NewObject:
    name, class_id = _line(entry, "name", kind, path), take_whole_number(entry, "class_id", kind, path)
    return NewObject(_id(entry, kind, path), name, class_id)


def _line(entry: dict[str, Any], key: str, context: str, path: Path) -> str:
    """A text that is shown to people. Raises PlgsError."""
    return one_line(take_text(entry, key, context, path))


def _moved(entry: dict[str, Any], kind: str, path: Path) -> MovedPoints:
    millimetres = _whole_numbers(entry, "millimetres", kind, path)
    if len(millimetres) % 3:
        raise wrong_type("millimetres", "three numbers a point", len(millimetres), kind, path)
    return MovedPoints(take_whole_number(entry, "label", kind, path), millimetres)


def _id(entry: dict[str, Any], kind: str, path: Path) -> int:
    number = take_whole_number(entry, "id", kind, path)
    if number < 1:
        raise wrong_type("id", "an object's id from 1 on", number, kind, path)
    return number


def _corner(entry: dict[str, Any], key: str, kind: str, path: Path) -> tuple[float, float, float]:
    values = take_list(entry, key, kind, path)
    if len(values) != 3:
        raise wrong_type(key, "three numbers", values, kind, path)
    x, y, z = (take_number({key: value}, key, kind, path) for value in values)
    return x, y, z


def _whole_numbers(entry: dict[str, Any], key: str, kind: str, path: Path) -> tuple[int, ...]:
    values = take_list(entry, key, kind, path)
    if not all(type(value) is int and abs(value) <= _FARTHEST for value in values):
        raise wrong_type(key, "a list of whole numbers", values, kind, path)
    return tuple(values)


def no_object(what: str, where: Path | str, known: list[int]) -> PlgsError:
    """The error for an object that is not there."""
    ids = ", ".join(map(str, known)) or "none"
    return PlgsError(what, where, f"Its objects are {ids}.")
