"""Everything in a lift folder belongs to it alone: no links, no FIFOs, no devices.

A lift may come from someone else. If its log were a link, resuming the lift would append to the link's target.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from stat import S_ISDIR, S_ISLNK, S_ISREG

from ..errors import PlgsError
from .atomic import PART

FILES = ("request.json", "corrections.json", "scene.json", "events.jsonl", "cancel", "preview.json", "log.txt")
FOLDERS = ("result", "bake", *(name + end for name in ("checkpoint", "preparation") for end in ("", ".next", ".old")))
_BEGINNINGS = (PART, "bake-")
"""The prefixes of files that are being written, and of logs that earlier versions left beside them."""


def refuse_foreign(lift: Path, *more: str) -> None:
    """Raise PlgsError if one of the lift's own files or folders, or of ``more`` files in them, is something else. What
    else the folders hold is not checked."""
    for name in (*FILES, *more):
        _refuse(lift / name, S_ISREG)
    for name in FOLDERS:
        _refuse(lift / name, S_ISDIR)


def refuse_foreign_below(lift: Path) -> None:
    """Like `refuse_foreign`, for everything in the lift's folders. Call it before writing or deleting there."""
    refuse_foreign(lift)
    tops = [lift / name for name in FOLDERS]
    tops += [path for path in _entries(lift) if path.name.startswith(_BEGINNINGS)]
    while tops:
        path = tops.pop()
        _refuse(path, lambda mode: S_ISREG(mode) or S_ISDIR(mode))
        tops += _entries(path)


def _entries(folder: Path) -> Iterator[Path]:
    """The entries of a folder; none if it is not a folder, or no longer exists."""
    try:
        with os.scandir(folder) as entries:
            yield from [Path(entry.path) for entry in entries]
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise PlgsError(f"cannot be read ({error.strerror})", folder, "Check its permissions and its disk.") from error


def _refuse(path: Path, is_right: Callable[[int], bool]) -> None:
    try:
        mode = os.lstat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        fix = "Check its permissions and its disk."
        raise PlgsError(f"cannot be examined ({error.strerror})", path, fix) from error
    if not is_right(mode):
        kind = "a link" if S_ISLNK(mode) else "neither a file nor a folder of a lift"
        raise PlgsError(f"is {kind}, which a lift never has", path, "Do not trust it. Copy only files you recognise.")
