"""A mask, a class and a score for each detection: an .npz a frame, or a folder of PNGs a frame.

* ``<frame>.npz``: ``masks`` [N, H, W] (bool, bytes, or shares above 0.5), ``classes`` [N] (numbers or names) and
  ``scores`` [N]; detectron2's ``pred_masks``, ``pred_classes`` and Hugging Face's ``labels`` are taken too.
* ``<frame>/<k>_<class>_<score>.png``: black and white; the class is a number or a name.

Where detections overlap, the one with the highest score is painted on top. Class numbers count from 0.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..class_tables import is_thing_by_name
from ..classes import LARGEST_CLASS_ID, ClassLabel
from ..frame import SceneError, Size
from ..layout import files_by_stem, natural_order, require_all, shown, shown_size
from .label_map import label_header, read_indices
from .mask_arrays import array_headers, read_array
from .painting import paint
from .source import FoundMask, FoundSegment, MaskSource

LOOKS_FOR = "<frame>.npz with masks, classes and scores, or <frame>/<k>_<class>_<score>.png"
_KEYS = {
    "masks": ("masks", "pred_masks"),
    "classes": ("classes", "pred_classes", "class_ids", "labels"),
    "scores": ("scores", "pred_scores", "score"),
}
_NAME = re.compile(r"(\d+)_(.+)_(\d*\.?\d+)", re.ASCII)
_FIX = "Save masks [N, H, W], classes [N] and scores [N] with numpy.savez, one file a frame."
_NAME_FIX = "Call it <k>_<class>_<score>.png, such as 3_chair_0.92.png."
_MOST = 10_000


@dataclass(frozen=True)
class Detection:
    """The class of one detection as the file says it, and its score."""

    word: str
    score: float


@dataclass(frozen=True)
class StackReader:
    """Reads one frame's .npz; ``segments`` in the order of its masks."""

    path: Path
    segments: tuple[FoundSegment, ...]

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        key = _key(self.path, "masks")
        masks = read_array(self.path, key)
        masks = masks.reshape(-1, *masks.shape[-2:])
        return _painted([mask > 0.5 if mask.dtype.kind == "f" else mask != 0 for mask in masks], self.segments, masks)


@dataclass(frozen=True)
class PicturesReader:
    """Reads one frame's PNGs, one a segment."""

    paths: tuple[Path, ...]
    segments: tuple[FoundSegment, ...]
    size: Size

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        masks = [read_indices(path) > 0 for path in self.paths]
        for path, mask in zip(self.paths, masks, strict=True):
            if mask.shape != self.size[::-1]:
                raise SceneError(f"this mask is not {shown_size(self.size)} as the others are", path, _NAME_FIX)
        return _painted(masks, self.segments, np.zeros((0, *self.size[::-1])))


def _painted(masks: Sequence[NDArray[np.bool_]], segments: tuple[FoundSegment, ...], like: NDArray[Any]) -> FoundMask:
    if not masks:
        return FoundMask(np.zeros(like.shape[-2:], np.int32), ())
    ids = paint(masks, segments)
    seen = {*np.unique(ids).tolist()}
    return FoundMask(ids, tuple(segment for segment in segments if segment.id in seen))


def recognises(place: Path) -> bool:
    if not place.is_dir():
        return False
    first = next(iter(sorted(place.glob("*.npz"))), None)
    if first is not None:
        return any(key in array_headers(first) for key in _KEYS["masks"])
    return any(_NAME.fullmatch(path.stem) for folder in _folders(place)[:3] for path in folder.glob("*.png"))


def _folders(place: Path) -> list[Path]:
    return sorted((path for path in place.iterdir() if path.is_dir()), key=lambda path: natural_order(path.name))


def read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the detections: headers, classes and scores. Raises SceneError."""
    if any(place.glob("*.npz")):
        return _from_stacks(place, names)
    return _from_folders(place, names)


def _from_stacks(place: Path, names: Sequence[str]) -> MaskSource:
    files = files_by_stem(place, {".npz"}, _FIX)
    require_all(names, files, "detections", place, _FIX)
    found = {name: _detections(files[name]) for name in names}
    label_of, labels = _labels(found.values())
    readers: dict[str, Callable[[], FoundMask]] = {
        name: StackReader(files[name], _segments(found[name], label_of)) for name in names
    }
    sizes = {name: _stack_size(files[name]) for name in names}
    return MaskSource(labels, readers, sizes, {name: files[name] for name in names}, void=frozenset())


def _from_folders(place: Path, names: Sequence[str]) -> MaskSource:
    folders = {path.name: path for path in _folders(place)}
    require_all(names, folders, "folder of detections", place, _NAME_FIX)
    paths = {name: _pictures(folders[name]) for name in names}
    require_all(names, [name for name in names if paths[name]], "detections", place, _NAME_FIX)
    found = {name: [_from_name(path) for path in paths[name]] for name in names}
    label_of, labels = _labels(found.values())
    sizes = {name: label_header(paths[name][0]).size for name in names}
    readers: dict[str, Callable[[], FoundMask]] = {
        name: PicturesReader(paths[name], _segments(found[name], label_of), sizes[name]) for name in names
    }
    return MaskSource(labels, readers, sizes, {name: paths[name][0] for name in names}, void=frozenset())


def _pictures(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(folder.glob("*.png"), key=lambda path: natural_order(path.stem)))


def _from_name(path: Path) -> Detection:
    match = _NAME.fullmatch(path.stem)
    if match is None or not 0.0 <= float(match[3]) <= 1.0:
        raise SceneError("the name does not tell class and score", path, _NAME_FIX)
    return Detection(match[2], float(match[3]))


def _detections(path: Path) -> list[Detection]:
    """The classes and scores in an .npz. Raises SceneError."""
    headers = array_headers(path)
    count = _count(headers[_key(path, "masks")].shape, path)
    classes, scores = read_array(path, _key(path, "classes")), read_array(path, _key(path, "scores"))
    if classes.shape != (count,) or scores.shape != (count,) or classes.dtype.kind not in "iuU":
        raise SceneError(f"there are not {count} classes and scores as there are masks", path, _FIX)
    if scores.dtype.kind != "f" or not ((scores >= 0.0) & (scores <= 1.0)).all():
        raise SceneError("scores are not between 0 and 1", path, _FIX)
    words = [str(word) for word in classes.tolist()]
    return [Detection(word, float(score)) for word, score in zip(words, scores.tolist(), strict=True)]


def _key(path: Path, what: str) -> str:
    headers = array_headers(path)
    for key in _KEYS[what]:
        if key in headers:
            return key
    raise SceneError(f'there are no "{what}"', path, _FIX)


def _count(shape: tuple[int, ...], path: Path) -> int:
    if (len(shape) != 3 and not (len(shape) == 4 and shape[1] == 1)) or 0 in shape[-2:] or shape[0] > _MOST:
        raise SceneError(f"masks have the shape {list(shape)}", path, _FIX)
    return shape[0]


def _stack_size(path: Path) -> Size:
    shape = array_headers(path)[_key(path, "masks")].shape
    return shape[-1], shape[-2]


def _labels(frames: Any) -> tuple[Mapping[str, int], tuple[ClassLabel, ...] | None]:
    """The label of each class, and the classes where they were named: numbers need a table that the user names."""
    words = sorted({one.word for found in frames for one in found})
    if all(word.isdecimal() and int(word) < LARGEST_CLASS_ID for word in words):
        return {word: int(word) for word in words}, None
    labels = [ClassLabel(n, shown(word), is_thing_by_name(word) is not False) for n, word in enumerate(words, start=1)]
    return {word: label.id for word, label in zip(words, labels, strict=True)}, tuple(labels)


def _segments(found: Sequence[Detection], label_of: Mapping[str, int]) -> tuple[FoundSegment, ...]:
    return tuple(FoundSegment(n, label_of[one.word], one.score) for n, one in enumerate(found, start=1))
