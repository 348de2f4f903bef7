"""Keep track of which files in a folder are ours: every file that a command writes into a folder that a user names is
listed in the folder's note. No other file there is ever replaced or deleted.

Each line of the note is a JSON object, appended before the file is put in place, so that the note also holds after a
kill:

    {"begins": "export", "about": {...}}               a run begins, which writes this
    {"file": "meshes/chair 1.glb"}                     the run writes this file
    {"file": "meshes/chair 1.glb", "sha256": HEX}      with this content
    {"complete": true}                                 last: all of it is written

A file with other content than we wrote is somebody else's. Passes carry their mark in their own header instead
(`passes.exr.is_own`), as several machines write them into one folder."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import unicodedata
from collections.abc import Mapping
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any, Self

from ..errors import PlgsError
from ..gates import inner_path, open_plain, open_to_append

PART = ".part-"
"""Prefix of names that are still being written. A kill leaves them behind."""
NOTE = ".plgs-written.jsonl"
"""The note's name in its folder."""
MOST_BYTES = 2**28
"""A larger note is refused: it takes tens of seconds to read."""
_LONGEST_PART, _LONGEST_NAME = 255, 2048  # bytes that file systems take

_Run = tuple[str, Mapping[str, Any]]
"""A kind of files, and of what they are."""


class OwnFiles:
    """The files in a folder that we wrote, as the folder's note lists them. In a ``with`` block, `write_atomically`
    lists what it writes below the folder, and raises PlgsError for a path that has somebody else's file."""

    def __init__(self, folder: Path) -> None:
        """Read the note; without one, no file is ours. Raises OSError, also if the note is a link or too large."""
        self.folder, self.is_complete = folder, False
        self.begun: _Run | None = None
        self._asked: _Run = ("", {})
        self._is_announced = False
        self._digests: dict[str, set[str]] = {}  # SHA-256 digests of each path's contents, by the path in one case
        self._kinds: dict[str, str] = {}  # by the path as it was written
        self._latest: set[str] = set()  # what the run that began last wrote
        with suppress(FileNotFoundError, NotADirectoryError), open_plain(folder / NOTE, follow_link=False) as file:
            if os.fstat(file.fileno()).st_size > MOST_BYTES:
                raise OSError(errno.EINVAL, f"it is larger than {MOST_BYTES / 1e6:.3g} MB", str(folder / NOTE))
            for line in file:
                self._take(line)

    def _take(self, line: bytes) -> None:
        self.is_complete = False
        # A line that a power cut left, or one that we did not write.
        with suppress(ValueError, AttributeError, TypeError, LookupError, RecursionError):
            entry = json.loads(line)
            if "begins" in entry:
                self.begun, self._latest = (entry["begins"], entry["about"]), set()
            elif self.begun is not None and "file" in entry:
                self._list(_possible(entry["file"]), entry.get("sha256"))
            self.is_complete = entry.get("complete") is True

    def _list(self, name: str, digest: str | None) -> None:
        assert self.begun is not None
        self._kinds[name] = self.begun[0]
        self._latest.add(name)
        known = self._digests.setdefault(_folded(name), set())
        if digest is not None:
            known.add(digest)

    def begin(self, kind: str, about: Mapping[str, Any], *, replaces: bool = False, among_others: bool = False) -> Self:
        """Set what the next run will write: a ``kind``, and ``about`` with the details, for the note. The folder must
        be new, empty, or of an equal run; with ``replaces``, a run of the same kind is enough; with ``among_others``,
        it may hold anything. Raises PlgsError for another folder, OSError."""
        self._asked = kind, json.loads(json.dumps(about))
        place = next(each for each in (self.folder, *self.folder.absolute().parents) if os.path.lexists(each))
        if not place.is_dir():
            what = "a folder is needed, but this is a file" if place.exists() else "this link leads nowhere"
            raise PlgsError("file-not-folder", what, place, "Name another folder.")
        if not os.access(place, os.W_OK):  # reported before any work
            raise PlgsError("not-writable", "this folder cannot be written to", place, "Name another folder.")
        is_same = self.begun == self._asked or (replaces and self.begun is not None and self.begun[0] == kind)
        if not (among_others or is_same) and self.folder.exists() and any(self.folder.iterdir()):
            what = "the folder has files of others" if self.begun is None else "the folder has other results of PLGS"
            raise PlgsError("folder-used", what, self.folder, "Name a new or an empty folder.")
        return self

    def __enter__(self) -> Self:
        GUARDS.append(self)
        return self

    def __exit__(self, *error: object) -> None:
        GUARDS.remove(self)

    def owns(self, path: Path) -> bool:
        """Whether a file exists and is as we wrote it. Raises OSError."""
        name = _folded(self._name(path))
        digests = self._digests.get(name)
        with suppress(FileNotFoundError, ValueError):  # not there, or behind a link that leads out of the folder
            if digests and _folded(path.resolve().relative_to(self.folder.resolve()).as_posix()) == name:
                return path.is_file() and sha256(path) in digests
        return False

    def claim(self, path: Path) -> None:
        """List a file as ours, before it is written. Raises PlgsError if somebody else's file is there, OSError."""
        name, part = self._name(path), path.with_name(PART + path.name)
        self.refuse_foreign(path)
        if os.path.lexists(part) and _folded(name) not in self._digests:
            raise foreign(part)
        if not self._is_announced:
            self.announce()
        self._append({"file": name})
        self._list(name, None)

    def announce(self) -> None:
        """Write the run's begin into the note, which makes the folder ours, before the first file. Raises OSError."""
        kind, about = self.begun = self._asked
        self._is_announced, self.is_complete, self._latest = True, False, set()
        self._append({"begins": kind, "about": about})

    def refuse_foreign(self, path: Path) -> None:
        """Raise PlgsError if somebody else's file is there. Raises OSError."""
        if os.path.lexists(path) and not self.owns(path):
            raise foreign(path)

    def set_aside(self, path: Path) -> Path | None:
        """Rename a file that is not ours to a new name such as "NAME.before.json". Returns the new path, None if there
        is no file or it is ours. Raises OSError."""
        if not os.path.lexists(path) or self.owns(path):
            return None
        numbers = chain([""], (f"_{number}" for number in count(2)))
        names = (path.with_name(f"{path.stem}.before{number}{path.suffix}") for number in numbers)
        kept = next(each for each in names if not os.path.lexists(each))
        path.rename(kept)
        return kept

    def record(self, path: Path, written: Path) -> None:
        """List the content of the claimed file ``path``, which is now complete at ``written``. Raises OSError."""
        name, digest = self._name(path), sha256(written)
        self._append({"file": name, "sha256": digest})
        self._list(name, digest)

    def complete(self) -> None:
        """Mark in the note that the run wrote all its files. Raises OSError."""
        if not self._is_announced and (self.begun != self._asked or not self.is_complete):
            self.announce()
        if not self.is_complete:
            self._append({"complete": True})
            self.is_complete = True

    def remove_earlier(self) -> None:
        """Delete our files of this kind that this run did not write. Raises OSError."""
        kept = {path.stat()[1:3] for name in self._latest if (path := self.folder / name).exists()}
        for name in [name for name, kind in self._kinds.items() if kind == self._asked[0]]:
            path = self.folder / name
            is_there = os.path.lexists(path) or os.path.lexists(path.with_name(PART + path.name))
            # By inode and device, not by name: a disk may list them in other case or Unicode form.
            if name not in self._latest and is_there and not (path.exists() and path.stat()[1:3] in kept):
                self.remove(path)

    def remove(self, path: Path) -> None:
        """Delete a file and its temporary file, if they are ours, and folders that become empty. Raises OSError."""
        if self.owns(path):
            path.unlink()
        part = path.with_name(PART + path.name)
        if _folded(self._name(path)) in self._digests and part.is_file() and not part.is_symlink():
            part.unlink()
        for folder in path.parents:
            if folder == self.folder:
                break
            with suppress(OSError):
                folder.rmdir()

    def discard(self) -> None:
        """Delete what the latest run wrote, and the folder if it becomes empty. Raises OSError."""
        for name in [*self._latest]:
            self.remove(self.folder / name)
        if {*self._kinds} <= self._latest:
            (self.folder / NOTE).unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()
        OwnFiles.__init__(self, self.folder)

    def _name(self, path: Path) -> str:
        return path.absolute().relative_to(self.folder.absolute()).as_posix()

    def _append(self, entry: Mapping[str, Any]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        with os.fdopen(open_to_append(self.folder / NOTE), "r+b") as note:
            size = note.seek(0, os.SEEK_END)
            note.seek(max(0, size - 1))
            is_cut = note.read(1) not in (b"", b"\n")
            line = json.dumps(entry).encode() + b"\n"
            note.write(b"\n" + line if is_cut else line)


GUARDS: list[OwnFiles] = []
"""The folders whose notes are kept at this moment, the innermost last."""


def guard_of(path: Path) -> OwnFiles | None:
    """Return the note of the folder that contains ``path``, if a ``with`` block keeps one now, else None."""
    whole = path.absolute()
    return next((each for each in reversed(GUARDS) if whole.is_relative_to(each.folder.absolute())), None)


def foreign(path: Path, fix: str = "Move it away, or write into another folder.", option: str = "") -> PlgsError:
    """Return the error for somebody else's file at a ``path`` where we would write. ``option`` names another place."""
    return PlgsError("foreign-file", "was not written by PLGS, or was changed since", path, fix, option=option)


def sha256(path: Path) -> str:
    """The file's SHA-256 in hex. Raises OSError."""
    with open_plain(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _possible(name: str) -> str:
    """Return ``name`` as a relative path. Raises ValueError if no file in a folder can have it."""
    path = inner_path(name)
    if max(len(os.fsencode(part)) for part in path.parts) > _LONGEST_PART or len(os.fsencode(path)) > _LONGEST_NAME:
        raise ValueError("a file's name is too long")
    return path.as_posix()


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
