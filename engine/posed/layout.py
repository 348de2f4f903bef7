"""Find and read a scene's files, match them to frames, and limit what they may claim. The frames of every format are
checked here when a scene is opened, so the readers need no limits of their own."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path, PureWindowsPath
from typing import TypeVar

from ..errors import MEMORY_IS_GONE, PlgsError, reading
from ..gates import read_plain
from ..job.progress import Progress, unwatched
from ..job.system import main_memory
from .frames import Camera, Size

Read = TypeVar("Read")
_SAME_SHAPE = 0.02  # relative difference of two aspect ratios that count as one: ScanNet's differ by 0.4 %
_LARGEST_SCALE = 8  # maximum width of a mask in widths of its picture: ARKitScenes' small pictures reach 7.5


def read_file(path: Path, most_bytes: int, fix: str = "Check that it exists.") -> bytes:
    """The content of a regular file of at most ``most_bytes``. Raises PlgsError, with ``fix`` as the advice."""
    with reading(path, fix):
        size = path.stat().st_size
        if size <= most_bytes:  # otherwise read_plain raises an error
            check_memory(size, path)
        return read_plain(path, most_bytes)


def read_text(path: Path, most_bytes: int, fix: str) -> str:
    """The content of a text file in UTF-8. Raises PlgsError for other files, with ``fix`` as the advice."""
    try:
        return read_file(path, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise PlgsError("not-text", "this is not a text file", path, fix) from error


def composed(name: str) -> str:
    """Return the name with composed letters (Unicode NFC): macOS writes ü as two characters, other systems as one."""
    return unicodedata.normalize("NFC", name)


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sort key that puts frame 9 before frame 10."""
    parts = re.findall(r"\d+|\D+", name)
    return (*((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts),)


def is_note(path: Path) -> bool:
    """Whether the operating system made this file: ._0001.png and .DS_Store (macOS), Thumbs.db (Windows)."""
    return path.name.startswith(".") or path.name.lower() in ("thumbs.db", "desktop.ini")


def shown_files(folder: Path, pattern: str = "*") -> Iterator[Path]:
    """Yield the entries of ``folder`` that match, unordered, without system files. Raises OSError only for "*"."""
    found = folder.iterdir() if pattern == "*" else folder.glob(pattern)
    return (path for path in found if not is_note(path))


def files_by_stem(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """Return the files of ``folder`` with one of ``suffixes`` (lower case, with the dot), in natural order, by stem
    (`composed`). Raises PlgsError, with ``fix`` as the advice, if folder or files are missing, or a stem repeats."""
    if not folder.is_dir():
        raise PlgsError("no-folder", "a folder is missing", folder, fix)
    with reading(folder, "Check its permissions."):
        paths = [*folder.iterdir()]
    found: dict[str, Path] = {}
    for path in sorted(paths, key=lambda path: (natural_order(path.stem), path.name)):
        if path.suffix.lower() not in suffixes or is_note(path):
            continue
        if path.is_symlink() and not path.exists():
            what = "the link is broken"
            raise PlgsError("dead-link", what, path, "Restore the file that it should lead to, or remove the link.")
        if not path.is_file():
            continue
        stem = composed(path.stem)
        if stem in found:
            raise PlgsError("two-files", f"{found[stem].name} has the same name, too", path, "Keep one of the two.")
        found[stem] = path
    if not found:
        raise PlgsError("no-files", f"the folder has no {' or '.join(sorted(suffixes))} files", folder, fix)
    return found


def require_all(names: Sequence[str], present: Collection[str], what: str, where: Path, fix: str) -> None:
    """Raise PlgsError unless all frames in ``names`` are in ``present``, too. ``what`` says which files are missing
    otherwise, ``where`` is the folder in which they should be."""
    lacking = [name for name in names if name not in present]
    if lacking:
        count = f"{len(lacking)} of {len(names)} frames have" if len(lacking) > 1 else "a frame has"
        raise PlgsError("lacks-files", f"{count} no {what} ({listed(lacking)})", where, fix)


def require_most(names: Sequence[str], present: Collection[str], what: str, where: Path, fix: str) -> list[str]:
    """Return the ``names`` of frames that are in ``present``. Raises like `require_all` if over half are missing."""
    there = [name for name in names if name in present]
    if 2 * len(there) < len(names):
        require_all(names, present, what, where, fix)
    return there


def of_most(names: Sequence[str], read: Callable[[str], Read], progress: Progress = unwatched) -> dict[str, Read]:
    """Call ``read`` with each name and return the results by name. Names for which ``read`` raises PlgsError are left
    out. If they are over half, the first error is raised; so is one that tells that memory is full."""
    found: dict[str, Read] = {}
    errors: list[PlgsError] = []
    for number, name in enumerate(names):
        progress(number, len(names))
        try:
            found[name] = read(name)
        except PlgsError as error:
            if MEMORY_IS_GONE in error.what:
                raise
            errors.append(error)
    if 2 * len(errors) > len(names):
        raise errors[0]
    return found


def file_inside(folder: Path, name: str, path: Path) -> Path:
    """Return the path of the file in ``folder`` that ``path`` calls ``name``. Raises PlgsError if that leads out."""
    # Windows' rules are the stricter ones: drives, both kinds of slashes.
    parts = PureWindowsPath(name)
    if parts.anchor or ".." in parts.parts or "\0" in name or not parts.parts:
        what = f'the file name "{shown(name)}" leaves the folder {folder.name}'
        raise PlgsError("leaves-folder", what, path, "Use plain names of files in that folder.")
    found = folder
    for part in parts.parts:
        here = found / part
        if not part.isascii() and not here.exists() and found.is_dir():  # macOS may have written it in NFD
            here = next((each for each in found.iterdir() if composed(each.name) == composed(part)), here)
        found = here
    return found


def plural(number: int, one: str, many: str = "") -> str:
    """Return a count with its noun, such as "1 frame is" or "3 frames are"; ``many`` defaults to ``one`` with an s."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def listed(names: Iterable[object], most: int = 5) -> str:
    """Return up to ``most`` names as text for a message, such as "0001, 0002, … and 7 more"."""
    texts = [shown(name) for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def shown(name: object) -> str:
    """Return a name that comes from someone else's file, made fit for one line of a terminal."""
    text = "".join(character if character.isprintable() else "?" for character in str(name))
    return text if len(text) <= 60 else f"{text[:59]}…"


def same_shape(one: Size, other: Size) -> bool:
    """Whether two pictures can show the same view: their aspect ratios agree within 2 %."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1.0) < _SAME_SHAPE


def fits_picture(size: Size, picture: Size) -> bool:
    """Whether a mask of this ``size`` can belong to a ``picture``: same aspect ratio, and not far larger."""
    return same_shape(size, picture) and size[0] <= _LARGEST_SCALE * picture[0]


def shown_size(size: Size) -> str:
    """Return the size as text, such as "640x480"."""
    return f"{size[0]}x{size[1]}"


_SHARE_OF_MEMORY = 0.5  # the fraction of the free memory that one file may take: the rest of the scene needs some, too
_SMALL = 1 << 25  # bytes; files smaller than this skip the free-memory check


def check_count(count: int, things: str, path: Path, fix: str, *, most: int, room: int, made: int) -> None:
    """Raise PlgsError if ``path`` claims a ``count`` of ``things`` above ``room`` (as many as fit into the rest of the
    file) or above ``most`` (as many as are read in ten seconds), or too many for memory at ``made`` bytes each."""
    if count > room:
        raise PlgsError("cut-off", "the file is cut off", path, fix)
    check_most(count, things, path, fix, most)
    check_memory(count * made, path)


def check_most(count: int, things: str, path: Path | str, fix: str, most: int) -> None:
    """Raise PlgsError if ``count``, the number of ``things`` found so far in the file ``path``, exceeds ``most``."""
    if count > most:
        raise PlgsError("too-many", f"the file has more than {most} {things}", path, fix)


def check_memory(size: int, path: Path) -> None:
    """Raise PlgsError if the ``size`` bytes that the file ``path`` unpacks to exceed half of the free memory."""
    memory = main_memory() if size > _SMALL else None
    if memory is not None and size > _SHARE_OF_MEMORY * memory.free:
        what = f"the file takes {size / 1e9:.2g} GB of memory, but only {memory.free / 1e9:.2g} GB are free"
        raise PlgsError("no-memory", what, path, "Close other programs, or use a computer with more memory.")


LARGEST_PIXELS = 2**27
_SMALLEST_SIDE = 4
_LONGEST_SHAPE = 20  # maximum ratio of a picture's sides
_FOCAL_LENGTHS = (0.001, 1000.0)  # relative to the picture's longer side: angles of view of 179.9 degrees and of 0.06


def check_camera(name: str, camera: Camera, path: Path) -> None:
    """Raise PlgsError for intrinsics or a picture's size that no camera has, and for a frame's ``name`` that cannot be
    shown in panels, tables and logs. ``path`` is the picture."""
    if not name.isprintable():
        what = f"the name of frame {shown(name)} cannot be shown as text"
        raise PlgsError("frame-name", what, path.parent, "Rename it.")
    check_size(f"the picture of frame {shown(name)}", camera.size, path)
    least, most = (share * max(camera.size) for share in _FOCAL_LENGTHS)
    if not (least <= camera.fx <= most and least <= camera.fy <= most):
        size = shown_size(camera.size)
        what = f"frame {shown(name)} has focal lengths of {camera.fx:.4g} and {camera.fy:.4g} pixels at {size}"
        raise PlgsError("focal-length", what, path, "Give its camera's focal lengths in pixels of the picture.")


def check_size(what: str, size: Size, path: Path) -> None:
    """Raise PlgsError for a picture's size that no camera makes. ``what`` is the subject of the message."""
    if min(size) < _SMALLEST_SIDE or max(size) > _LONGEST_SHAPE * min(size):
        fix = f"Use at least {_SMALLEST_SIDE} pixels per side, and no side more than {_LONGEST_SHAPE} times the other."
        raise PlgsError("impossible-size", f"{what} is {shown_size(size)}, which no camera produces", path, fix)
