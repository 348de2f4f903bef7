"""The list of recent lifts, by which a newly started Blender finds running and finished ones. It lies in the user's
cache folder and is only a convenience: a broken list is replaced."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import PlgsError
from ..json_file import read_object, take_list, to_text
from ..records import record_of, refuse_other_format
from .atomic import write_atomically
from .environment import notes_folder
from .folder import LiftFolder, LiftState
from .lock import FileLock

MOST = 50
_FIX = "Delete it."
_LATEST = 1 << 40
"""Unix seconds beyond any clock. We never write a later time."""


@dataclass(frozen=True)
class RecentLift:
    """A lift in the list. ``touched`` is when an engine last began or ended there, in Unix seconds."""

    folder: LiftFolder
    state: LiftState
    touched: float


@dataclass(frozen=True)
class _Entry:
    path: str
    touched: float = field(metadata={"least": 0, "most": _LATEST})


def recent_lifts(cache: Path | None = None, most: int = MOST) -> list[RecentLift]:
    """Return at most ``most`` of the listed lifts that still exist, newest first, with their state at a glance. It
    takes a few milliseconds and never raises: what cannot be read is left out."""
    lifts = []
    for path, touched in _entries(_list_path(cache))[:most]:
        try:
            folder = LiftFolder.open(Path(path))
            lifts.append(RecentLift(folder, folder.state_at_a_glance(), touched))
        except (PlgsError, OSError):  # deleted, on an unplugged disk, or from another version
            continue
    return lifts


def remembered_lifts(cache: Path | None = None) -> list[str]:
    """Return the paths listed in ``cache`` (None: the user's), newest first, without checking them."""
    return [path for path, _ in _entries(_list_path(cache))]


def remember_lift(path: Path, cache: Path | None = None) -> None:
    """Put a lift folder at the top of the list. Raises OSError or PlgsError if the list cannot be written."""
    list_path = _list_path(cache)
    list_path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(list_path.with_suffix(".lock"), wait_s=20.0):  # a slow disk takes a tenth for each
        lift = str(path.absolute())
        others = [entry for entry in _entries(list_path, is_to_be_replaced=True) if entry[0] != lift]
        entries = [(lift, round(time.time(), 3)), *others][:MOST]
        listed = [{"path": path, "touched": touched} for path, touched in entries]
        write_atomically(list_path, to_text({"format": 1, "lifts": listed}))


def _list_path(cache: Path | None) -> Path:
    return (cache or notes_folder()) / "recent_lifts.json"


def _entries(list_path: Path, is_to_be_replaced: bool = False) -> list[tuple[str, float]]:
    """Return the path and time of each entry; none if the list is missing, broken or from another version. Raises
    PlgsError if the disk cannot read a list that ``is_to_be_replaced``, as its entries would be lost."""
    try:
        content = read_object(list_path, _FIX)
        refuse_other_format(content, list_path)
        listed = take_list(content, "lifts", "the list", list_path)
    except PlgsError as error:
        if is_to_be_replaced and isinstance(error.__cause__, OSError) and list_path.exists():
            raise
        return []
    entries = []
    for each in listed:
        with suppress(PlgsError):  # a damaged entry: the other lifts keep their places in the list
            entry = record_of(_Entry, each if isinstance(each, dict) else {}, list_path, _FIX, "lifts")
            entries.append((entry.path, entry.touched))
    return entries
