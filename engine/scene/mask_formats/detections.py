"""A mask, a class and a score for each detection: one .npz, or one folder of PNGs, per frame.

* ``<frame>.npz``: ``masks`` [N, H, W] (see ``values.inside``), ``classes`` [N] (numbers or names) and ``scores`` [N],
  or what detectron2 and Hugging Face call these. SAM 3's tracks are read too, under the names of Hugging Face or of its
  own package: a number is one object in all frames, ``classes`` may be left out, and ``classes.toml`` may give each
  number a class, as with SAM 2.
* ``<frame>/<k>_<class>_<score>.png``: black and white; the class is a number or a name.

Of detections that overlap, the one with the highest score is on top. Class numbers count from 0."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ...errors import PlgsError
from ...json_file import whole_number
from ...posed.array_file import array_headers, read_array
from ...posed.classes import LARGEST_CLASS_ID, ClassLabel
from ...posed.layout import listed, natural_order, require_most, shown_files
from ..files_of_frames import DETECTION, files_of_frames, mask_files
from ..values import inside
from ..view import Progress, watched
from .source import FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask, named_labels, painted, pile

_KEYS = {
    "masks": ("masks", "pred_masks", "out_binary_masks"),
    "classes": ("classes", "pred_classes", "class_ids", "labels"),
    "scores": ("scores", "pred_scores", "score", "out_probs"),
    "tracks": ("object_ids", "out_obj_ids"),
}
_FIX = "Save masks [N, H, W], classes [N] and scores [N] with numpy.savez, one file per frame."
_NAME_FIX = "Name it <k>_<class>_<score>.png, such as 3_chair_0.92.png."
_MOST = 10_000


@dataclass(frozen=True)
class Detection:
    """A detection: its class as in the file, and its score. ``track`` is its object's number in all frames, if any;
    without classes, the number is the class (``word``), too."""

    word: str
    score: float
    track: int | None = None


def _recognises(place: Path) -> bool:
    if not place.is_dir():
        return False
    first = next(iter(mask_files(place, ".npz")), None)
    if first is not None:
        return any(key in array_headers(first) for key in _KEYS["masks"])
    pictures = (path for folder in _folders(place)[:3] for path in shown_files(folder, "*.png"))
    return any(DETECTION.fullmatch(path.stem) for path in pictures)


def _folders(place: Path) -> list[Path]:
    return sorted((path for path in shown_files(place) if path.is_dir()), key=lambda path: natural_order(path.name))


def _read(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    if mask_files(place, ".npz"):
        files = files_of_frames(place, names, {".npz"}, what="detections", fix=_FIX, progress=progress)
        found = {name: _detections(path) for name, path in files.items()}
        label_of, labels = _labels(found.values())
        masks = {}
        for name, path in files.items():
            shape = array_headers(path)[_key(path, "masks")].shape
            read = partial(_read_stack, path, _segments(found[name], label_of))
            masks[name] = StoredMask(path, (shape[-1], shape[-2]), read)
        no_class = [name for name, path in files.items() if not _has(path, "classes")]
        if no_class and len(no_class) < len(files):
            raise PlgsError("classes-partly", f"some files have classes, but not {listed(no_class)}", place, _FIX)
        return MaskSource(masks, labels, void=frozenset(), tells_no_class=bool(no_class))
    folders = {path.name: path for path in _folders(place)}
    there = require_most(names, folders, "folder of detections", place, _NAME_FIX)
    pictures = {
        name: sorted(shown_files(folders[name], "*.png"), key=lambda path: natural_order(path.name)) for name in there
    }
    paths = {name: found for name, found in pictures.items() if found}
    require_most(names, paths, "detections", place, _NAME_FIX)
    found = {name: [_from_name(path) for path in each] for name, each in paths.items()}
    label_of, labels = _labels(found.values())
    each = watched([*paths], progress)
    masks = {name: pile(paths[name], _segments(found[name], label_of), _NAME_FIX) for name in each}
    return MaskSource(masks, labels, void=frozenset())


def _read_stack(path: Path, segments: Sequence[FoundSegment]) -> FoundMask:
    """Read the mask in an .npz. ``segments`` are in the order of its detections."""
    masks = read_array(path, _key(path, "masks"))
    masks = masks.reshape(-1, *masks.shape[-2:])  # [N, 1, H, W] of networks, or [H, W]
    return painted((inside(mask, path) for mask in masks), segments, (masks.shape[2], masks.shape[1]))


def _from_name(path: Path) -> Detection:
    match = DETECTION.fullmatch(path.stem)
    if match is None or not 0.0 <= float(match[3]) <= 1.0:
        raise PlgsError("detection-name", "the name does not give class and score", path, _NAME_FIX)
    return Detection(match[2], float(match[3]))


def _detections(path: Path) -> list[Detection]:
    headers = array_headers(path)
    count, *_ = shape = headers[_key(path, "masks")].shape
    if (len(shape) != 3 and not (len(shape) == 4 and shape[1] == 1)) or 0 in shape[-2:] or count > _MOST:
        raise PlgsError("shape", f"masks have the shape {list(shape)}", path, _FIX)
    tracks = read_array(path, _key(path, "tracks")) if _has(path, "tracks") else None
    if tracks is not None and not (
        tracks.shape == (count,) and tracks.dtype.kind in "iu" and ((tracks >= 0) & (tracks < LARGEST_CLASS_ID)).all()
    ):
        raise PlgsError("unequal-counts", f"there are {count} masks, but not as many object numbers", path, _FIX)
    classes = tracks if tracks is not None and not _has(path, "classes") else read_array(path, _key(path, "classes"))
    scores = read_array(path, _key(path, "scores"))
    if classes.shape != (count,) or scores.shape != (count,) or classes.dtype.kind not in "iuU":
        raise PlgsError("unequal-counts", f"there are {count} masks, but not as many classes and scores", path, _FIX)
    if scores.dtype.kind != "f" or not ((scores >= 0.0) & (scores <= 1.0)).all():
        raise PlgsError("bad-scores", "scores are not between 0 and 1", path, _FIX)
    numbers = [None] * count if tracks is None else tracks.tolist()
    rows = zip(classes.tolist(), scores.tolist(), numbers, strict=True)
    return [Detection(str(word), float(score), track) for word, score, track in rows]


def _has(path: Path, what: str) -> bool:
    return any(key in array_headers(path) for key in _KEYS[what])


def _key(path: Path, what: str) -> str:
    headers = array_headers(path)
    for key in _KEYS[what]:
        if key in headers:
            return key
    raise PlgsError("no-array", f'there are no "{what}"', path, _FIX)


def _labels(frames: Iterable[Sequence[Detection]]) -> tuple[dict[str, int], tuple[ClassLabel, ...] | None]:
    """Return a number for each class label, and the classes that the file names. These are None if the labels are only
    numbers, whose table the user must name."""
    words = {one.word for found in frames for one in found}
    numbers = {word: number for word in words if (number := whole_number(word)) is not None}
    if len(numbers) == len(words) and max(numbers.values(), default=0) < LARGEST_CLASS_ID:
        return numbers, None
    return named_labels(words)


def _segments(found: Sequence[Detection], label_of: Mapping[str, int]) -> tuple[FoundSegment, ...]:
    numbered = enumerate(found, start=1)
    return tuple(FoundSegment(n, label_of[one.word], one.score, track=one.track) for n, one in numbered)


FORMAT = MaskFormat("detections", _recognises, _read)
