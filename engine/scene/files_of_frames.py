"""Which file belongs to which frame, where a folder of a capture or of masks has one file per frame."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from hashlib import file_digest, sha256
from pathlib import Path

from ..errors import PlgsError
from ..posed.image_header import read_image_header
from ..posed.layout import files_by_stem, of_most, require_most

IMAGES = frozenset({".png", ".jpg", ".jpeg"})
"""The ends of image files' names, in lower case."""
_COLOUR_WORDS = frozenset("rgb rgba frame image img color colour".split())
_MASK_WORDS = frozenset(
    "rgb rgba frame image img semantic semantics sem class classes instance instances label labels mask masks seg"
    " segmentation panoptic".split()
)


def files_if_any(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """``files_by_stem``, but no files at all when there is no such folder."""
    return files_by_stem(folder, suffixes, fix) if folder.is_dir() else {}


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
    if path.suffix.lower() in IMAGES:
        read_image_header(path)
    elif not path.is_file() or not path.stat().st_size:
        raise PlgsError("file-empty", "the file is missing, or empty", path, "Write this file again.")
    return path


def digests_of_files(groups: Sequence[tuple[Path | None, ...]]) -> list[str]:
    """For each group of files the start of the SHA-256 of what is in them, where None stands for no file; empty where
    one of them cannot be read, or is a folder. A file is read once in each process, unless it changes."""
    found = []
    for group in groups:
        try:
            states = [(path, path.stat()) for path in group if path is not None]
            read = [_digest(path, state.st_size, state.st_mtime_ns) for path, state in states]
        except OSError:
            found.append("")
            continue
        found.append(sha256(b"".join(read)).hexdigest()[:16])
    return found


@cache
def _digest(path: Path, size: int, changed_ns: int) -> bytes:
    with open(path, "rb") as file:
        return file_digest(file, "sha256").digest()


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
