"""Write files completely or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..errors import ErrorCode, PlgsError
from ..gates import create_plain
from .own_files import PART, guard_of
from .own_files import sha256 as sha256
from .system import flush_folder

WRITTEN: set[Path] = set()
"""Every path that this process wrote. What else lies beside is somebody else's, or an earlier run's."""


def write_atomically(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a file so that readers, even after a kill at any point, see the old content or the new, never a mixture.
    ``content`` is the bytes, a text (written as UTF-8), or a function that writes the file at the path it is given.
    That path is in the same folder and ends like ``path``, so libraries that choose a format by suffix choose the right
    one. Only one process at a time may write a given path. Raises what the function or the file system raises, and
    PlgsError if another process removed the unfinished file or, while an `OwnFiles` keeps the folder's note, if
    somebody else's file is there; ``path`` is then as it was. An OSError names the file."""
    guard = guard_of(path)
    if guard is not None:
        guard.claim(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(PART + path.name)
    try:
        if callable(content):
            part.unlink(missing_ok=True)  # a link that someone left there would lead elsewhere
            content(part)
        else:
            with create_plain(part) as file:
                file.write(content.encode() if isinstance(content, str) else content)
        try:
            flush_to_disk(part)
            if guard is not None:
                guard.record(path, part)
            os.replace(part, path)
        except FileNotFoundError as error:
            if callable(content):  # perhaps it wrote nothing
                raise
            what = "another process wrote this file at the same time"
            raise PlgsError("taken-over", what, path, "Try again in a moment.", code=ErrorCode.BUSY) from error
    except BaseException as error:  # also Ctrl-C: it must not leave a part behind
        with suppress(OSError):  # as it fails on a disk that is read-only
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(part), part):
            error.filename = str(path)
        raise
    WRITTEN.add(path)
    flush_to_disk(path.parent)  # else a power cut may lose the new name


def flush_to_disk(path: Path) -> None:
    """Flush a file's content, or a folder's list of names, to the disk, to survive a power cut. Raises OSError."""
    if path.is_dir():
        return flush_folder(path)
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only files that are open for writing
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_parts(folder: Path) -> None:
    """Delete unfinished files of killed writers under ``folder``. Only the holder of the folder's lock may do so."""
    for part in sorted(folder.rglob(PART + "*")):  # a list, as deleting changes what rglob walks
        if part.is_dir():
            shutil.rmtree(part)
        else:
            part.unlink(missing_ok=True)


@dataclass(frozen=True)
class ListedFile:
    """A listed file: the path relative to the folder, the size in bytes, and the SHA-256 in hex."""

    path: PurePosixPath
    bytes: int
    sha256: str

    @classmethod
    def of(cls, path: Path, folder: Path) -> ListedFile:
        """Describe the file ``path`` of the ``folder`` as it is now: name, size and digest. Raises OSError."""
        return cls(PurePosixPath(path.relative_to(folder)), path.stat().st_size, sha256(path))


def files_below(folder: Path) -> Iterator[Path]:
    """Yield every completely written file under ``folder``, in a fixed order."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith(PART):
            yield path
