"""One edit: what it does, when it was made, and what it refers to; and corrections.json, the edits of a lift in the
order in which they were made. A label is one number for class and object together: the object's id, or minus the class
where there is no object (0 is unknown). No edit is ever removed: an undone edit is marked as undone. Writers take
turns, and each adds to what it has just read, so two Blenders that edit the same lift lose nothing."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

from ..errors import ErrorCode, PlgsError
from ..job import write_atomically
from ..job.lock import FileLock
from ..json_file import Json, read_object, take_objects, take_whole_number
from ..records import record_of, to_json

CORRECTIONS = "corrections.json"
KINDS = ("rename", "reclass", "merge", "delete", "split", "assign", "accept", "remove")
"""The kinds that this version knows. Edits of other kinds are kept but not applied."""
MOVES = ("delete", "split", "assign")
"""The kinds that give points other labels."""
PER_METRE = 1000
"""Points are kept in millimetres."""
_FARTHEST = 10**9
"""Millimetres: the largest coordinate of a point."""
_BOUNDS = {"least": -_FARTHEST, "most": _FARTHEST}
_SHOWN = {"shown": True}
MEND = "Repair the file, or move it away to see the lift as the engine made it."


@dataclass(frozen=True)
class ObjectMark:
    """An object as it was when it was edited, so that it can be recognised in another lift: its id, its number of
    points, and the corners ``low`` and ``high`` of their upright box in metres (without the outermost points)."""

    id: int = field(metadata={"least": 1})
    points: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class NewObject:
    """An object that an edit creates: its id, name and class."""

    id: int = field(metadata={"least": 1})
    name: str = field(metadata=_SHOWN)
    class_id: int

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("a new object has no name")


@dataclass(frozen=True)
class MovedPoints:
    """Points that an edit gives another label. ``millimetres`` holds their x, y, z, x, y, z, ...."""

    label: int
    millimetres: tuple[int, ...] = field(metadata=_BOUNDS)

    def __post_init__(self) -> None:
        if len(self.millimetres) % 3:
            raise ValueError("'millimetres' needs three numbers for each point")


@dataclass(frozen=True)
class Edit:
    """A person's change of a lift's objects or labels. It is an entry of corrections.json. It has a ``kind``
    ("rename", "merge" …), a unique ``uid`` and the ``time``. Fields that its kind does not use are empty. A rename has
    a ``name``. A reclass has a ``class_id``, as has a split whose first part changes its class; ``names`` are what the
    ``objects`` are called then, "" as before. A merge turns all ``objects`` into the first. A move gives points of the
    ``objects`` and of the stuff ``classes`` other labels (``moved``), perhaps of objects that it ``made``; ``rest`` is
    the label of the objects' other points, None where they keep theirs. A removal takes the ``objects`` out of the
    room; ``fill`` names the file of what replaces them, and ``digest`` is its SHA-256. ``raw`` is the entry as it was
    read, for kinds that this version does not know."""

    kind: str = field(metadata=_SHOWN)
    objects: tuple[ObjectMark, ...] = ()
    name: str = field(default="", metadata=_SHOWN)
    class_id: int = 0
    names: tuple[str, ...] = field(default=(), metadata=_SHOWN)
    classes: tuple[int, ...] = field(default=(), metadata=_BOUNDS)
    moved: tuple[MovedPoints, ...] = ()
    made: tuple[NewObject, ...] = ()
    rest: int | None = None
    fill: str = field(default="", metadata=_SHOWN)
    digest: str = field(default="", metadata=_SHOWN)
    undone: bool = False
    uid: str = field(default_factory=lambda: uuid4().hex)
    time: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"), metadata=_SHOWN)
    raw: Mapping[str, Json] | None = field(default=None, metadata={"apart": True})

    @property
    def largest_id(self) -> int:
        """The largest id of the objects that the edit refers to."""
        return max([*(mark.id for mark in self.objects), *(new.id for new in self.made)], default=0)

    def to_json(self) -> dict[str, Any]:
        if self.raw is not None:
            return {**self.raw, "undone": self.undone}
        return to_json(self)


@dataclass(frozen=True)
class _Unknown:
    """The fields that an edit has whatever its kind, also a kind that this version does not know."""

    kind: str = field(metadata=_SHOWN)
    uid: str
    time: str = field(metadata=_SHOWN)


def edit_of(entry: dict[str, Any], path: Path) -> Edit:
    """Return the edit in an ``entry`` of corrections.json, at ``path``. Raises PlgsError if it is damaged."""
    for key in ("kind", "uid", "time"):
        if not entry.get(key):
            raise PlgsError("edit-incomplete", f"an edit has no '{key}'", path, MEND)
    if entry["kind"] not in KINDS:
        shown = record_of(_Unknown, {key: entry[key] for key in ("kind", "uid", "time")}, path, MEND, "an edit")
        return Edit(shown.kind, undone=entry.get("undone") is True, uid=shown.uid, time=shown.time, raw=entry)
    edit = record_of(Edit, entry, path, MEND, str(entry["kind"]), raw=None)
    if edit.kind == "rename" and not edit.name:
        raise PlgsError("edit-name-empty", "'rename.name' is empty", path, MEND)
    if edit.kind == "remove" and not (edit.fill.isalnum() and len(edit.fill.encode()) <= 64 and edit.digest):
        raise PlgsError("edit-no-fill", "'remove.fill' or 'remove.digest' is missing or wrong", path, MEND)
    return edit


FORMAT = 1
_WAIT_S = 20.0


def read_edits(lift: Path) -> tuple[Edit, ...]:
    """Return the edits of the lift in this folder, undone ones included; none without a file. Raises PlgsError if the
    file is damaged or from a later version; its edits are then neither shown nor changed."""
    path = lift / CORRECTIONS
    if not path.exists():
        return ()
    content = read_object(path, MEND)
    version = take_whole_number(content, "format", "the file", path)
    if version != FORMAT:
        fix = "Use the version of PLGS that wrote it. The file was not changed."
        raise PlgsError("other-format", f"the file has format {version}, but this version reads {FORMAT}", path, fix)
    collecting = gc.isenabled()
    gc.disable()  # nothing is freed here, and looking for garbage among 100 000 edits doubles the time
    try:
        edits = tuple(edit_of(entry, path) for entry in take_objects(content, "edits", "the file", path))
    finally:
        if collecting:
            gc.enable()
    if len({edit.uid for edit in edits}) < len(edits):
        raise PlgsError("edit-uid-twice", "two edits have the same uid", path, MEND)
    return edits


@contextmanager
def editing(lift: Path) -> Iterator[list[Edit]]:
    """Give a ``with`` block the list of edits to change, and write it at the block's end. Other writers wait until
    then. Raises PlgsError if the file is damaged or busy, and OSError; nothing is then written."""
    folder = lift / "bake"
    folder.mkdir(exist_ok=True)
    try:
        with FileLock(folder / "corrections.lock", _WAIT_S):
            before = read_edits(lift)
            edits = list(before)
            yield edits
            if tuple(edits) != before:
                lines = (json.dumps(edit.to_json(), ensure_ascii=False, allow_nan=False) for edit in edits)
                entries = ",\n".join(lines)
                write_atomically(lift / CORRECTIONS, f'{{"format": {FORMAT}, "edits": [\n{entries}\n]}}\n')
    except PlgsError as error:
        if error.key != "at-work":
            raise
        what, fix = "another program is editing this lift", "Try again in a moment."
        raise PlgsError("corrections-busy", what, lift / CORRECTIONS, fix, code=ErrorCode.BUSY) from error
