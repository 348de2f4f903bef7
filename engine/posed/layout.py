"""Files of a scene: reading them, and which of them belong to which frame by their stems."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import TypeVar

from ..errors import MEMORY_IS_GONE, PlgsError
from ..gates import read_plain
from .counts import check_memory
from .frames import Size
from .image_header import read_image_header

Read = TypeVar("Read")
_COLOUR_WORDS = frozenset("rgb rgba frame image img color colour".split())
_MASK_WORDS = frozenset(
    "rgb rgba frame image img semantic semantics sem class classes instance instances label labels mask masks seg"
    " segmentation panoptic".split()
)
_SAME_SHAPE = 0.02
"""Relative difference of two aspect ratios that still counts as one: ScanNet has 1296x968 beside 640x480 (0.4 %)."""


def read_file(path: Path, most_bytes: int, fix: str = "Check that it exists.") -> bytes:
    """The content of a regular file of at most ``most_bytes``. Raises PlgsError, with ``fix`` as the advice."""
    try:
        size = path.stat().st_size
        if size <= most_bytes:
            check_memory(size, path)
        return read_plain(path, most_bytes)
    except OSError as error:
        raise PlgsError(f"the file cannot be read ({error.strerror})", path, fix) from error


def read_text(path: Path, most_bytes: int, fix: str) -> str:
    """The content of a text file in UTF-8. Raises PlgsError; ``fix`` is the advice for other files."""
    try:
        return read_file(path, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise PlgsError("this is not a text file", path, fix) from error


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sorting key by which frame 9 comes before frame 10."""
    parts = re.findall(r"\d+|\D+", name)
    return (*((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts),)


def files_by_stem(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """Files of ``folder`` with one of ``suffixes`` (lower case, with the dot), by stem, in natural order.

    Raises PlgsError, with ``fix`` as the advice, when there is no such folder or file, or when a stem occurs twice.
    """
    if not folder.is_dir():
        raise PlgsError("a folder is missing", folder, fix)
    try:
        paths = [*folder.iterdir()]
    except OSError as error:
        raise PlgsError(f"the folder cannot be read ({error.strerror})", folder, "Check its permissions.") from error
    found: dict[str, Path] = {}
    for path in sorted(paths, key=lambda path: (natural_order(path.stem), path.name)):
        # A name that starts with a dot is a file system's own note, such as macOS makes.
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.is_symlink() and not path.exists():
            raise PlgsError("this link leads nowhere", path, "Give the file it should lead to, or remove the link.")
        if not path.is_file():
            continue
        if path.stem in found:
            raise PlgsError(f"there is {found[path.stem].name} as well", path, "Keep one of the two.")
        found[path.stem] = path
    if not found:
        raise PlgsError(f"the folder has no {' or '.join(sorted(suffixes))} files", folder, fix)
    return found


def files_if_any(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """``files_by_stem``, but no files at all when there is no such folder."""
    return files_by_stem(folder, suffixes, fix) if folder.is_dir() else {}


def require_all(names: Sequence[str], present: Collection[str], what: str, where: Path, fix: str) -> None:
    """Raise PlgsError unless every frame of ``names`` is ``present``. ``what`` names the missing thing."""
    lacking = [name for name in names if name not in present]
    if lacking:
        count = f"{len(lacking)} of {len(names)} frames have" if len(lacking) > 1 else "a frame has"
        raise PlgsError(f"{count} no {what} ({listed(lacking)})", where, fix)


def require_most(names: Sequence[str], present: Collection[str], what: str, where: Path, fix: str) -> list[str]:
    """The frames of ``names`` that are ``present``. Raises as ``require_all`` when more than half of them are not."""
    there = [name for name in names if name in present]
    if 2 * len(there) < len(names):
        require_all(names, present, what, where, fix)
    return there


def of_most(names: Sequence[str], read: Callable[[str], Read]) -> dict[str, Read]:
    """What ``read`` gives for each frame of ``names``, without those for which it raises PlgsError. When these are more
    than half, or no memory is left, raises that error."""
    found: dict[str, Read] = {}
    errors: list[PlgsError] = []
    for name in names:
        try:
            found[name] = read(name)
        except PlgsError as error:
            if MEMORY_IS_GONE in error.what:
                raise
            errors.append(error)
    if 2 * len(errors) > len(names):
        raise errors[0]
    return found


def files_of_frames(
    folder: Path, names: Sequence[str], suffixes: Collection[str], what: str, fix: str
) -> dict[str, Path]:
    """The file of each frame of ``names`` in ``folder``, without frames whose file is missing, empty, or an image that
    is cut off. Raises as ``files_by_stem`` and, when these are more than half, ``require_most`` and ``of_most``."""
    files = of_same_number(names, files_by_stem(folder, suffixes, fix))
    return of_most(require_most(names, files, what, folder, fix), lambda name: whole_file(files[name]))


def files_of_both(
    one: Path, other: Path, names: Sequence[str], suffixes: Collection[str], fix: str
) -> tuple[dict[str, Path], dict[str, Path]]:
    """The masks of each frame in two folders, as ``files_of_frames`` finds them; frames that have both."""
    first = files_of_frames(one, names, suffixes, "mask", fix)
    second = files_of_frames(other, list(first), suffixes, "mask", fix)
    return {name: first[name] for name in second}, second


def whole_file(path: Path) -> Path:
    """``path``. Raises PlgsError for an empty file, and for an image without an end."""
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        read_image_header(path)
    elif not path.is_file() or not path.stat().st_size:
        raise PlgsError("the file is missing, or empty", path, "Write this file again.")
    return path


def of_same_number(names: Sequence[str], files: Mapping[str, Path]) -> Mapping[str, Path]:
    """The files of the frames ``names``, by name, whose stems differ only in words for kinds of pictures, as ``rgb_0``
    and ``semantic_class_0`` do; no file that another resembles so. ``files`` themselves where one has a frame's name.
    """
    keys = {name: _without(_COLOUR_WORDS, name) for name in names}
    if any(name in files for name in names) or len({*keys.values()}) < len(names):
        return files
    of_key: dict[tuple[int | str, ...], list[Path]] = {}
    for stem, path in files.items():
        of_key.setdefault(_without(_MASK_WORDS, stem), []).append(path)
    return {name: of_key[key][0] for name, key in keys.items() if len(of_key.get(key, ())) == 1}


def _without(words: Collection[str], stem: str) -> tuple[int | str, ...]:
    """The numbers and the other words of a name; a name without numbers as it is."""
    parts = [part for part in re.findall(r"\d+|[^\W\d_]+", stem.casefold()) if part not in words]
    return tuple(int(part) if part.isdecimal() else part for part in parts) if re.search(r"\d", stem) else (stem,)


def file_inside(folder: Path, name: str, path: Path) -> Path:
    """The file in ``folder`` that the file ``path`` calls ``name``. Raises PlgsError if it is outside."""
    # Windows' rules are the stricter ones: drives, both kinds of slashes.
    parts = PureWindowsPath(name)
    if parts.anchor or ".." in parts.parts or "\0" in name or not parts.parts:
        what = f'the file name "{shown(name)}" leaves the folder {folder.name}'
        raise PlgsError(what, path, "Use plain names of files in that folder.")
    return folder.joinpath(*parts.parts)


def listed(names: Iterable[object], most: int = 5) -> str:
    """A few names for a message: "0001, 0002, … and 7 more"."""
    texts = [shown(name) for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def shown(name: object) -> str:
    """A foreign file's name for something, fit for one line of a terminal."""
    text = "".join(character if character.isprintable() else "?" for character in str(name))
    return text if len(text) <= 60 else f"{text[:59]}…"


def same_shape(one: Size, other: Size) -> bool:
    """Whether two pictures can show the same view: their aspect ratios agree within 2 %."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1.0) < _SAME_SHAPE


def shown_size(size: Size) -> str:
    """ "640x480" """
    return f"{size[0]}x{size[1]}"
