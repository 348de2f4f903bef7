"""Match files to frames, in folders of a capture or of masks with one file per frame. What a folder holds is judged by
its files, never by its name."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from hashlib import file_digest, sha256
from pathlib import Path
from typing import TypeVar

from ..errors import PlgsError
from ..job.progress import Progress, part_of, unwatched
from ..posed.image_header import read_image_header
from ..posed.layout import composed, files_by_stem, of_most, require_most, shown_files
from .pixels import is_black_and_white, shows_one_object

IMAGES = frozenset({".png", ".jpg", ".jpeg"})  # suffixes of image files, in lower case
AMG_LIST = "metadata.csv"  # a file that SAM's amg.py writes into the folder of each picture
DETECTION = re.compile(r"(\d+)_(.+)_(\d*\.?\d+)", re.ASCII)  # the stem of a detection's mask: number, class, score
_FOLDERS_LOOKED_AT, _FILES_LOOKED_AT = 2, 8
_NAMES_TRIED = 5
Value = TypeVar("Value")
_COLOUR_WORDS = frozenset("rgb rgba frame image img color colour".split())
_MASK_WORDS = frozenset(
    "rgb rgba frame image img semantic semantics sem class classes instance instances label labels mask masks seg"
    " segmentation panoptic".split()
)


def files_if_any(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """Return the files of a folder by stem, as ``files_by_stem`` does, or {} if there is no such folder."""
    return files_by_stem(folder, suffixes, fix) if folder.is_dir() else {}


def mask_files(folder: Path, *suffixes: str) -> list[Path]:
    """Return the files of a folder with one of ``suffixes``. If there are none, return those in its subfolders, one for
    each camera of a rig; subfolders for a single object or picture do not count. Raises OSError."""
    if not folder.is_dir():
        return []
    shown = sorted(shown_files(folder))
    found = [path for path in shown if path.suffix.lower() in suffixes and path.is_file()]
    folders = [] if found else [path for path in shown if path.is_dir()]
    if not any(is_camera(path) or not _is_of_one(path) for path in folders[:_FOLDERS_LOOKED_AT]):
        return found
    inside = (sorted(path for path in shown_files(camera) if path.suffix.lower() in suffixes) for camera in folders)
    return found or [path for paths in inside for path in paths if path.is_file()]


def is_camera(folder: Path) -> bool:
    """Whether a folder of masks belongs to a camera of a rig: a folder of photos has a subfolder of that name."""
    beside = (path / folder.name for path in folder.parent.parent.iterdir() if path.name != folder.parent.name)
    firsts = (min(shown_files(path), default=None) for path in beside if path.is_dir())
    return any(first is not None and first.suffix.lower() in IMAGES and not shows_one_object(first) for first in firsts)


def _is_of_one(folder: Path) -> bool:
    """Whether a folder holds the masks of a single object or of a single picture."""
    first = min(shown_files(folder, "*.[pP][nN][gG]"), default=None)
    is_listed = (folder / AMG_LIST).exists() or (first is not None and DETECTION.fullmatch(first.stem))
    return bool(is_listed) or (first is not None and shows_one_object(first))


def says_what_counts(folder: Path) -> bool:
    """Whether a folder's PNGs are black and white. If so, they mark the pixels that count, and are not class masks."""
    pictures = mask_files(folder, ".png") if folder.is_dir() and not mask_files(folder, ".json") else []
    looked = [pictures[i * len(pictures) // _FILES_LOOKED_AT] for i in range(min(len(pictures), _FILES_LOOKED_AT))]
    return bool(looked) and all(is_black_and_white(path) for path in looked)


def kept_pixels(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The black-and-white picture of each frame that has one; white pixels count. Raises PlgsError without any PNGs."""
    return {name: path for name, path in of_same_name(names, _files(folder, {".png"}, "")).items() if name in {*names}}


def _files(folder: Path, suffixes: Collection[str], fix: str) -> dict[str, Path]:
    """Return the files in a folder by stem (``files_by_stem``) or, for a rig, by camera and stem."""
    inside = [path for path in mask_files(folder, *suffixes) if path.parent != folder]
    if not inside:
        return files_by_stem(folder, suffixes, fix)
    named = (("_".join(path.relative_to(folder).with_suffix("").parts), path) for path in inside)
    return {composed(name): path for name, path in named}


def files_of_frames(
    folder: Path, names: Sequence[str], suffixes: Collection[str], *, what: str, fix: str, progress: Progress
) -> dict[str, Path]:
    """Return the file in ``folder`` of each frame in ``names``. Frames whose file is missing, empty, or a truncated
    image are left out. Raises PlgsError if these are over half, or two files have one name."""
    files = of_same_name(names, _files(folder, suffixes, fix))
    return of_most(require_most(names, files, what, folder, fix), lambda name: whole_file(files[name]), progress)


def files_of_both(
    one: Path, other: Path, names: Sequence[str], *, suffixes: Collection[str], fix: str, progress: Progress
) -> tuple[dict[str, Path], dict[str, Path]]:
    """Return the files from both folders, by frame, of the frames that have one in each (``files_of_frames``)."""
    first = files_of_frames(one, names, suffixes, what="mask", fix=fix, progress=part_of(progress, 0.0, 0.5))
    second = files_of_frames(other, list(first), suffixes, what="mask", fix=fix, progress=part_of(progress, 0.5, 1.0))
    return {name: first[name] for name in second}, second


def whole_file(path: Path) -> Path:
    """Return ``path`` unchanged. Raises PlgsError for an empty file or a truncated image."""
    if path.suffix.lower() in IMAGES:
        read_image_header(path)
    elif not path.is_file() or not path.stat().st_size:
        raise PlgsError("file-empty", "the file is missing, or empty", path, "Write this file again.")
    return path


def digests_of_files(groups: Sequence[tuple[Path | None, ...]], progress: Progress = unwatched) -> list[str]:
    """Return the start of the SHA-256 of each group of files (None: no file), "" if one is a folder or unreadable."""
    found = []
    for number, group in enumerate(groups):
        progress(number, len(groups))
        try:
            read = [_digest(path) for path in group if path is not None]
        except OSError:
            found.append("")
            continue
        found.append(sha256(b"".join(read)).hexdigest()[:16])
    return found


_digests: dict[tuple[object, ...], bytes] = {}


def _digest(path: Path) -> bytes:
    """Return the SHA-256 of a file. Digests are cached: a file is read again if it changed. Raises OSError."""
    state = path.stat()
    key = (state.st_dev, state.st_ino or path, state.st_size, state.st_mtime_ns)  # some shares number no files
    if key not in _digests:
        with open(path, "rb") as file:
            _digests[key] = file_digest(file, "sha256").digest()
    return _digests[key]


def of_same_name(names: Sequence[str], files: Mapping[str, Value]) -> Mapping[str, Value]:
    """Return the file of each frame in ``names``, out of ``files`` by stem. Files have the frames' names; or else their
    stems have the same addition in all frames (``0001_pred``), or lack the same beginning (``front_0001`` for
    ``images_front_0001``); or else a frame has a single file whose name differs only in words for kinds of pictures
    (``rgb_0`` and ``semantic_class_0``)."""
    if any(name in files for name in names):
        return files
    if found := _with_addition(names, files):
        return found
    keys = {name: _without(_COLOUR_WORDS, name) for name in names}
    if len({*keys.values()}) < len(names):
        return files
    of_key: dict[tuple[int | str, ...], list[Value]] = {}
    for stem, value in files.items():
        of_key.setdefault(_without(_MASK_WORDS, stem), []).append(value)
    return {name: of_key[key][0] for name, key in keys.items() if len(of_key.get(key, ())) == 1}


def _with_addition(names: Sequence[str], files: Mapping[str, Value]) -> dict[str, Value]:
    """Pair frames with files whose stems are the frames' names with the same addition, or without the same beginning.
    Of several additions, the one that fits most frames is used."""
    ways: set[tuple[str, str, str]] = set()
    for name in names[:: max(1, len(names) // _NAMES_TRIED)]:
        for stem in files:
            before, found, after = stem.partition(name)
            if found and not before[-1:].isalnum() and not after[:1].isalnum():  # 1 in 1_pred, but not in 10
                ways.add(("", before, after))
            elif name.endswith(stem) and not name.removesuffix(stem)[-1:].isalnum():
                ways.add((name.removesuffix(stem), "", ""))
    found_by = []
    for lacking, before, after in ways:
        stems = {name: f"{before}{name.removeprefix(lacking)}{after}" for name in names if name.startswith(lacking)}
        paired = {name: files[stem] for name, stem in stems.items() if stem in files}
        found_by.append((-len(paired), len(before) + len(after), before, after, paired))
    best = min(found_by, default=None, key=lambda each: each[:4])
    if best is None or 2 * len(best[-1]) < len(names):
        return {}
    # Another addition that fits as many must extend the best; 0001_semantic and 0001_instance would be a guess.
    rivals = [each for each in found_by if each[0] == best[0]]
    return best[-1] if all(each[2].endswith(best[2]) and each[3].startswith(best[3]) for each in rivals) else {}


def _without(words: Collection[str], stem: str) -> tuple[int | str, ...]:
    """Return a name's numbers and its words other than ``words``, for comparison; if it has no number, all of it."""
    parts = [part for part in re.findall(r"\d+|[^\W\d_]+", stem.casefold()) if part not in words]
    return tuple(int(part) if part.isdecimal() else part for part in parts) if re.search(r"\d", stem) else (stem,)
