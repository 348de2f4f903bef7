"""Checks for everything that comes from other people: files, paths, texts, addresses. Standard library only. Only plain
(regular) files are opened, and they are read only up to a given size: a FIFO would block the program that opens it,
reading a device may have side effects, and a link may lead out of the folder. A file is refused by an OSError with its
own message, which is reported like errors of the system."""

from __future__ import annotations

import errno
import os
import re
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath
from stat import S_ISREG
from typing import BinaryIO

_USER = re.compile(r"(?<=://)[^/@\s]+@")
_SAFE = sum(getattr(os, name, 0) for name in ("O_BINARY", "O_CLOEXEC", "O_NOCTTY", "O_NONBLOCK"))
"""Flags that never wait for the other end of a FIFO. Plain files are not affected. Windows has only some of them."""
_NO_LINK: int = getattr(os, "O_NOFOLLOW", 0)


def open_plain(path: Path, *, follow_link: bool = True) -> BufferedReader:
    """Open a plain file for reading. Raises OSError, also for a folder, a device or, unless ``follow_link``, a link."""
    descriptor = _open(path, os.O_RDONLY, follow_link)
    return os.fdopen(descriptor, "rb")


def read_plain(path: Path, most_bytes: int) -> bytes:
    """The content of a plain file. Raises OSError, including for one that is larger than ``most_bytes``."""
    try:
        with open_plain(path) as file:
            size = os.fstat(file.fileno()).st_size
            content = file.read(most_bytes + 1) if size <= most_bytes else b""  # it may grow; files of /proc claim 0
    except MemoryError as error:
        raise OSError(errno.ENOMEM, "no memory is left for it", str(path)) from error
    if size > most_bytes or len(content) > most_bytes:
        raise OSError(errno.EINVAL, f"it is larger than {most_bytes / 1e6:.3g} MB", str(path))
    return content


def refuse_special(path: Path) -> None:
    """Raise OSError if ``path`` is not a plain file. Call it before a library opens that path."""
    if not S_ISREG(os.stat(path).st_mode):
        raise _special(path)


def open_to_append(path: Path) -> int:
    """Open a plain file for reading and appending, and create it if it is missing. Returns its descriptor. Raises
    OSError, also for a link, and for a file with hard links elsewhere, where its content would change too."""
    descriptor = _open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, follow_link=False)
    if os.fstat(descriptor).st_nlink > 1:
        os.close(descriptor)
        raise OSError(errno.EMLINK, "it has a second name elsewhere (a hard link)", str(path))
    return descriptor


def create_plain(path: Path) -> BinaryIO:
    """Open a new file for writing; a file that had its name is replaced. Raises OSError."""
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK | _SAFE, 0o666), "wb")


def _open(path: Path, flags: int, follow_link: bool) -> int:
    try:
        descriptor = os.open(path, flags | _SAFE | (0 if follow_link else _NO_LINK), 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP and not follow_link:
            raise OSError(errno.ELOOP, "it is a link", str(path)) from error
        if error.errno == errno.ENXIO:  # a FIFO that nobody reads, a socket
            raise _special(path) from error
        raise
    if not S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _special(path)
    return descriptor


def _special(path: Path) -> OSError:
    return OSError(errno.EINVAL, "it is not a plain file", str(path))


def inner_path(text: str) -> PurePosixPath:
    """Return ``text`` as a relative path. Raises ValueError if it leads out of its folder by the rules of Windows, the
    strictest: drives, shares (opening one sends the user's credentials there), both kinds of slashes."""
    parts = PureWindowsPath(text)
    if parts.anchor or ".." in parts.parts or not parts.parts or "\0" in text:
        raise ValueError(f"{text!r} leaves the folder")
    return PurePosixPath(text)


def printable(text: object) -> str:
    """Return the text with "?" for each character that a terminal takes as a command (colours, cursor moves) or cannot
    show (half surrogate pairs, from paths that are not UTF-8). Line breaks and tabs stay."""
    line = str(text)
    return line if line.isprintable() else "".join(one if one.isprintable() or one in "\n\t" else "?" for one in line)


def one_line(text: object) -> str:
    """Return ``printable(text)`` on one line."""
    return " ".join(printable(text).split("\n"))


def shortened(text: object, longest: int) -> str:
    """Return ``one_line(text)`` with runs of blanks reduced to one, cut to at most ``longest`` characters."""
    line = " ".join(one_line(text).split())
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


def table_cell(value: object) -> object:
    """Return a value for a CSV table. Text becomes ``one_line``, with an apostrophe before what a spreadsheet would
    take for a formula; other values stay."""
    if not isinstance(value, str):
        return value
    return f"'{one_line(value)}" if value.startswith(("=", "+", "-", "@", "\t", "\r")) else one_line(value)


def markdown_cell(text: object) -> str:
    """Return ``one_line(text)`` for a cell of a Markdown table, in which it cannot end a column or begin a tag."""
    return one_line(text).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


def plot_label(text: object) -> str:
    """Return ``one_line(text)`` for a plot: matplotlib would take text between two dollar signs as a formula."""
    return one_line(text).replace("$", r"\$")


def without_credentials(text: str) -> str:
    """Return the text with ``****`` in place of the user name and password in any address."""
    return _USER.sub("****@", text)
