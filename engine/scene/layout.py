"""Which files belong to which frame: folders of files that share their stems."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from .frame import SceneError, Size

_SAME_SHAPE = 0.02
"""Relative difference of two aspect ratios that still counts as one: ScanNet has 1296x968 beside 640x480 (0.4 %)."""


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sorting key by which frame 9 comes before frame 10."""
    parts = re.findall(r"\d+|\D+", name)
    return (*((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts),)


def files_by_stem(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """Files of ``folder`` with one of ``suffixes`` (lower case, with the dot), by stem, in natural order.

    Raises SceneError, with ``fix`` as the advice, when there is no such folder or file, or when a stem occurs twice.
    """
    if not folder.is_dir():
        raise SceneError("a folder is missing", folder, fix)
    try:
        paths = [*folder.iterdir()]
    except OSError as error:
        raise SceneError(f"the folder cannot be read ({error.strerror})", folder, "Check its permissions.") from error
    found: dict[str, Path] = {}
    for path in sorted(paths, key=lambda path: (natural_order(path.stem), path.name)):
        # A name that starts with a dot is a file system's own note, such as macOS writes.
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.is_symlink() and not path.exists():
            raise SceneError("this link leads nowhere", path, "Give the file it should lead to, or remove the link.")
        if not path.is_file():
            continue
        if path.stem in found:
            raise SceneError(f"there is {found[path.stem].name} as well", path, "Keep one of the two.")
        found[path.stem] = path
    if not found:
        raise SceneError(f"the folder has no {' or '.join(sorted(suffixes))} files", folder, fix)
    return found


def require_all(names: Sequence[str], present: Collection[str], what: str, where: Path, fix: str) -> None:
    """Raise SceneError unless every frame of ``names`` is ``present``; ``what`` is what the frame would lack."""
    lacking = [name for name in names if name not in present]
    if lacking:
        count = f"{len(lacking)} of {len(names)} frames have" if len(lacking) > 1 else "a frame has"
        raise SceneError(f"{count} no {what} ({listed(lacking)})", where, fix)


def listed(names: Iterable[object], most: int = 5) -> str:
    """A few names for a message: "0001, 0002, … and 7 more"."""
    texts = [shown(name) for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def shown(name: object) -> str:
    """A name out of somebody's file, fit for one line of a terminal."""
    text = "".join(character if character.isprintable() else "?" for character in str(name))
    return text if len(text) <= 60 else f"{text[:59]}…"


def same_shape(one: Size, other: Size) -> bool:
    """Whether two pictures can show the same view: their aspect ratios agree within 2 %."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1.0) < _SAME_SHAPE


def shown_size(size: Size) -> str:
    """ "640x480" """
    return f"{size[0]}x{size[1]}"
