"""Detections as COCO writes them: the run lengths (RLE) or polygons of all frames in one JSON.

Supported are COCO's results, which detectron2 and ultralytics write, too; instance annotations of COCO and LVIS;
SA-1B's and SAM's lists for one picture, in a folder with one JSON per frame; and SA-V's masklets, whose indices are
tracks. A detection of several classes has one entry for each, or ``scores`` by category id. As masks of their own,
detections are painted with the best on top; over other masks they overlap (``overlapping``)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...job.progress import Progress, part_of, unwatched
from ...json_file import (
    LARGEST_TABLE,
    read_json,
    shown_json,
    take_list,
    take_number,
    take_objects,
    take_text,
    take_whole_number,
    whole_number,
    wrong_type,
)  # fmt: skip
from ...posed.classes import LARGEST_CLASS_ID, ClassLabel
from ...posed.layout import LARGEST_PIXELS, listed, shown_files, shown_size
from ..frame import Size
from ..pixels import nearest_pixels
from ..view import watched
from .coco import images_of, read_categories, stem_of, take_score
from .source import LARGEST_TRACK, FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask, named_labels, painted

_FIX = "Write run lengths with pycocotools' encode, as detectron2 and ultralytics do."
_SIZE_FIX = "Give the image its width and height under images, or write run lengths."
_KINDS = "Give COCO results, COCO or LVIS instances, or masklets of SA-V."
_RLE = re.compile(rb"(?:[P-o]{0,6}[0-O])+")  # six bits a character; the highest says that the number continues
_WORD = "class_name"
_LOOKED_AT, _LEAST_COMPARED, _MOST_COMPARED = 50, 5, 1 << 22
"""Detections whose outlines are compared, at most and at least, in pictures of at most as many pixels."""
_EVERY = 4  # SA-V has masklets for every fourth frame of its videos


@dataclass(frozen=True)
class DetectedSegment:
    """A detection. ``label`` is its class's number in the file (None: no class), ``score`` in 0..1, ``runs`` compressed
    run lengths as in COCO for a picture of ``size`` (width, height). ``track`` is its object's number in all frames."""

    label: int | None
    score: float
    size: Size
    runs: bytes
    track: int | None = None

    def inside(self, path: Path, size: Size | None = None) -> NDArray[np.bool_]:
        """Return the detection's pixels, bool [H, W], at ``size`` (width, height), chosen as by `resize_nearest`, or at
        its own. Time and memory grow with it. Raises PlgsError for damaged run lengths, with ``path`` as their file."""
        width, height = self.size
        counts = _counts_of(self.runs)
        if not len(counts) or counts.min() < 0 or counts.sum() != width * height:
            what = f"run lengths of a detection do not fill its picture of {shown_size(self.size)}"
            raise PlgsError("bad-rle", what, path, _FIX)
        if size in (None, self.size):
            return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(width, height).T
        rows, columns = nearest_pixels(self.size, size)
        runs = np.searchsorted(np.cumsum(counts), columns[:, None] * height + rows, side="right")
        return (runs % 2 == 1).T


@dataclass(frozen=True)
class DetectionTable:
    """The content of a file of detections. ``entries`` pairs a picture's id with the file's entry for a detection;
    ``names`` and ``sizes`` are those of pictures by id, as text; ``labels`` are its classes, None if it does not name
    them. ``video_frames`` is a video's number of frames if the ids are indices of its frames."""

    path: Path
    entries: Sequence[tuple[str, dict[str, Any]]]
    names: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, Size] = field(default_factory=dict)
    labels: tuple[ClassLabel, ...] | None = None
    video_frames: int = 0

    def of_frames(
        self, frames: Mapping[str, Size | None], images: Mapping[str, str], progress: Progress = unwatched
    ) -> tuple[dict[str, tuple[DetectedSegment, ...]], tuple[str, ...]]:
        """Return the detections of the ``frames``, by name, and a warning about pictures that are not frames. The
        frames' sizes are given where known; ``images`` are further names of pictures by id. Raises PlgsError for bad
        entries and without any match."""
        frame_of = self._frames_of({image for image, _ in self.entries}, [*frames], {**images, **self.names})
        others = sorted({image for image, _ in self.entries} - frame_of.keys())
        if others and not frame_of:
            fix = "Let image_id be the name or number of a frame, or list id and file_name of each under images."
            raise PlgsError("unknown-images", f"no frame has these image ids ({listed(others)})", self.path, fix)
        found: dict[str, list[DetectedSegment]] = {}
        in_frames = part_of(progress, 0.0, 1.0, len(frames))
        for position, (image, entry) in enumerate(watched(self.entries, in_frames)):
            if image in frame_of and entry.get("iscrowd") != 1:
                name = frame_of[image]
                size, context = self.sizes.get(image) or frames[name], f"detection {position}"
                detected = (self._detection(one, context, size) for one in self._each_class(entry, context))
                found.setdefault(name, []).extend(detected)
        count = f"{len(others)} of {len(others) + len(frame_of)}"
        warning = f"{count} images with detections are not frames: {listed(others)}"
        return {name: tuple(each) for name, each in found.items()}, (warning,) if others else ()

    def _frames_of(self, images: set[str], names: Sequence[str], stems: Mapping[str, str]) -> dict[str, str]:
        """Return the frame of ``names`` for each picture by its id: by the stem of its file, by the id as a frame's
        name or number, or by index in a video."""
        if self.video_frames:
            step = 1 if self.video_frames == len(names) else _EVERY
            if step == _EVERY and not _EVERY * (self.video_frames - 1) < len(names) <= _EVERY * self.video_frames:
                what = f"masklets of {self.video_frames} frames do not belong to these {len(names)} frames"
                raise PlgsError("masklets-of-others", what, self.path, "Take all frames of the video, or every fourth.")
            return {image: names[int(image) * step] for image in images if int(image) * step < len(names)}
        known = {*names}
        numbers = {int(digits[-1]): name for name in names if (digits := re.findall(r"\d+", name))}
        by_number = numbers if len(numbers) == len(names) and not known.intersection(stems.values()) else {}
        found = {}
        for image in images:
            stem = stems.get(image) or (image if image in known else stem_of(image))  # some ids are files' names
            name = stem if stem in known else by_number.get(-1 if (number := whole_number(image)) is None else number)
            if name is not None:
                found[image] = name
        return found

    def is_by_number(self, names: Sequence[str]) -> bool:
        """Whether pictures are known only by a number that belongs to no frame of ``names``: they cannot be matched."""
        images = {image for image, _ in self.entries} - self.names.keys() - {*names}
        return bool(images) and not images <= self._frames_of(images, names, {}).keys()

    def _each_class(self, entry: dict[str, Any], context: str) -> list[dict[str, Any]]:
        """Return the entry, or one for each class if it has ``scores`` by category id."""
        if "scores" not in entry:
            return [entry]
        scores = entry["scores"]
        numbers = [whole_number(key) for key in scores] if isinstance(scores, dict) else []
        if not numbers or None in numbers:
            raise wrong_type("scores", "an object with a score for each category id", scores, context, self.path)
        each = zip(numbers, scores.values(), strict=True)
        return [entry | {"category_id": number, "score": score} for number, score in each]

    def _detection(self, entry: dict[str, Any], context: str, size: Size | None) -> DetectedSegment:
        label = None
        if entry.get("category_id") is not None:
            label = take_whole_number(entry, "category_id", context, self.path, least=0, most=LARGEST_CLASS_ID)
        if "score" not in entry and "predicted_iou" in entry:  # SAM's own estimate, which may exceed 1
            entry = entry | {"score": min(take_number(entry, "predicted_iou", context, self.path, least=0.0), 1.0)}
        if isinstance(entry.get("score"), list) and len(entry["score"]) == 1:  # as Grounded-SAM-2's demos write it
            entry = entry | {"score": entry["score"][0]}
        score = take_score(entry, context, self.path)
        size, runs = compressed(entry.get("segmentation"), size, context, self.path)
        track = None
        if entry.get("track") is not None:
            track = take_whole_number(entry, "track", context, self.path, least=0, most=LARGEST_TRACK)
        return DetectedSegment(label, score, size, runs, track)


def _counts_of(runs: bytes) -> NDArray[np.int64]:
    """Decode COCO's compressed run lengths, int64 [runs]: each number has five bits per character, lowest first, and
    from the fourth on is stored minus the number two before it."""
    characters = np.frombuffer(runs, np.uint8).astype(np.int64) - 48
    ends = np.flatnonzero(characters & 32 == 0)
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(len(characters)) - np.repeat(starts, ends - starts + 1)
    numbers = np.add.reduceat((characters & 31) << 5 * place, starts)
    numbers -= np.where(characters[ends] & 16, np.int64(1) << 5 * (ends - starts + 1), 0)
    numbers[1::2] = np.cumsum(numbers[1::2])
    numbers[2::2] = np.cumsum(numbers[2::2])
    return numbers


def compressed(given: Any, size: Size | None, context: str, path: Path) -> tuple[Size, bytes]:
    """Return the size and compressed run lengths of a COCO segmentation: run lengths, compressed or not, or polygons in
    a picture of this ``size``. Raises PlgsError, which names ``context`` and ``path``."""
    from pycocotools import mask as rle_tools  # late, as above

    if isinstance(given, dict):
        height, width = _whole_numbers(take_list(given, "size", context, path), "size", 2, context, path)
        check_picture((width, height), context, path)
        counts = given.get("counts")
        if isinstance(counts, str):
            runs = counts.encode(errors="replace")
            if not _RLE.fullmatch(runs):
                raise PlgsError("bad-rle", f"the run lengths of {context} are damaged", path, _FIX)
            return (width, height), runs
        whole = _whole_numbers(take_list(given, "counts", context, path), "counts", None, context, path)
        if sum(whole) != width * height:
            what = f"the run lengths of {context} do not fill its picture of {shown_size((width, height))}"
            raise PlgsError("bad-rle", what, path, _FIX)
        packed = rle_tools.frPyObjects({"size": [height, width], "counts": _without_empty(whole)}, height, width)
        return (width, height), packed["counts"]
    if not isinstance(given, list):
        raise wrong_type("segmentation", "run lengths or polygons", given, context, path)
    if size is None:
        raise PlgsError("no-size", f"the polygons of {context} lack the size of their picture", path, _SIZE_FIX)
    check_picture(size, context, path)
    polygons = [_polygon(one, size, context, path) for one in given]
    if not polygons:
        raise PlgsError("bad-polygon", f"{context} has no polygon", path, _FIX)
    return size, rle_tools.merge(rle_tools.frPyObjects(polygons, size[1], size[0]))["counts"]


def _without_empty(counts: list[int]) -> list[int]:
    """Return the same runs without empty ones, except perhaps the first."""
    kept = [0]
    for place, count in enumerate(counts):
        if count and len(kept) % 2 == place % 2:
            kept.append(0)
        kept[-1] += count
    return kept


def check_picture(size: Size, context: str, path: Path) -> None:
    """Raise PlgsError if a picture's size is less than 1 or has more than LARGEST_PIXELS pixels."""
    if min(size) < 1 or size[0] * size[1] > LARGEST_PIXELS:
        what = f"the picture of {context} has {size[0]} x {size[1]} pixels"
        raise PlgsError("bad-picture-size", what, path, "Write its height and width in pixels.")


def _whole_numbers(values: list[Any], key: str, count: int | None, context: str, path: Path) -> list[int]:
    """Return the ``count`` whole numbers from 0 to LARGEST_PIXELS in ``values``. Raises PlgsError for other values; it
    names the entry ``context``, its ``key`` and the file ``path``."""
    wrong = [one for one in values if type(one) is not int or not 0 <= one <= LARGEST_PIXELS]
    if wrong or (count is not None and len(values) != count):
        amount = "" if count is None else f"{count} "
        raise wrong_type(key, f"a list of {amount}numbers of pixels", wrong[0] if wrong else values, context, path)
    return values


def _polygon(values: Any, size: Size, context: str, path: Path) -> list[float]:
    """Return the corners of a polygon as x, y, x, y, ..., moved into the picture. Raises PlgsError for other lists."""
    numbers = values if isinstance(values, list) else []
    are_finite = all(type(one) in (int, float) and abs(one) < 1e300 for one in numbers)
    if len(numbers) < 6 or len(numbers) % 2 or not are_finite:
        what = f"a polygon of {context} is not x and y of at least three corners, but {shown_json(values)}"
        raise PlgsError("bad-polygon", what, path, _FIX)
    corners = np.clip(np.array(numbers, np.float64).reshape(-1, 2), 0, size)
    return [*corners.ravel().tolist()]


def read_table(place: Path) -> DetectionTable:
    """Read detections from a file, a folder with one file, or one with a file a frame. Raises PlgsError for others."""
    files = sorted(shown_files(place, "*.json")) if place.is_dir() else [place]
    if len(files) != 1:
        tables = [(path.stem, _table_of(path)) for path in files]
        entries = [(name, entry) for name, table in tables for _, entry in table.entries]
        sizes = {name: next(iter(table.sizes.values())) for name, table in tables if len(table.sizes) == 1}
        labels = {table.labels: name for name, table in tables}
        if len(labels) > 1:
            what = "the categories of {}.json and {}.json differ".format(*labels.values())
            raise PlgsError("classes-differ", what, place, "Write the same categories into all files.")
        return _checked(DetectionTable(place, entries, {}, sizes, next(iter(labels), None)))
    return _checked(_table_of(files[0]))


def _checked(table: DetectionTable) -> DetectionTable:
    """Return the table with numbers for classes that entries give by name only, as Grounded-SAM-2's do. Raises
    PlgsError for shapes that COCO counts differently: normalised polygons, and run lengths along rows."""
    found = [entry for _, entry in table.entries]
    polygons = [one for entry in found if isinstance(entry.get("segmentation"), list) for one in entry["segmentation"]]
    numbers = [each for one in polygons if isinstance(one, list) for each in one if type(each) in (int, float)]
    if numbers and max(map(abs, numbers)) <= 1.0:
        what = "the polygons lie within the first pixel, as if their corners were shares of the picture"
        fix = "Multiply x by the picture's width and y by its height."
        raise PlgsError("normalised-polygons", what, table.path, fix)
    runs = [runs for entry in found if isinstance(runs := entry.get("segmentation"), dict)][:_LOOKED_AT]
    if _are_along_rows([each for each in runs if isinstance(each.get("counts"), list)]):
        what = "the run lengths look counted along rows, and COCO counts down columns"
        raise PlgsError("runs-along-rows", what, table.path, 'Encode the masks with order "F", as pycocotools does.')
    words = {str(entry[_WORD]) for entry in found if entry.get("category_id") is None and _WORD in entry}
    if not words or table.labels is not None:
        return table
    number_of, labels = named_labels(words)
    entries = [
        (image, entry | {"category_id": number_of[str(entry[_WORD])]} if str(entry.get(_WORD)) in number_of else entry)
        for image, entry in table.entries
    ]
    return replace(table, entries=entries, labels=labels)


def _are_along_rows(segmentations: Sequence[dict[str, Any]]) -> bool:
    """Whether outlines of run lengths are far shorter if read along rows; COCO's order, down columns, gives stripes."""
    as_columns = as_rows = seen = 0
    for each in segmentations:
        size: Any = each.get("size")
        counts = each["counts"]
        numbers = [*size, *counts] if isinstance(size, list) and len(size) == 2 and len(counts) > 2 else [None]
        if not all(type(one) is int and 0 <= one <= _MOST_COMPARED for one in numbers):
            continue  # the reader raises the error later
        if sum(counts) != size[0] * size[1] or sum(counts) > _MOST_COMPARED:
            continue
        values = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        for pixels, is_rows in ((values.reshape(size[::-1]), False), (values.reshape(size), True)):
            edges = sum(int(np.count_nonzero(np.diff(pixels, axis=axis))) for axis in (0, 1))
            as_rows, as_columns = as_rows + edges * is_rows, as_columns + edges * (not is_rows)
        seen += 1
    return seen >= _LEAST_COMPARED and 2 * as_rows < as_columns


def _table_of(path: Path) -> DetectionTable:
    content = read_json(path)
    if isinstance(content, list):
        content = {"annotations": content}
    if isinstance(content, dict) and "masklet" in content:
        return _masklets(take_list(content, "masklet", "the file", path), path)
    if not isinstance(content, dict) or "annotations" not in content:
        raise PlgsError("not-detections", "the JSON has no detections", path, _KINDS)
    sizes = {}
    for position, image in enumerate(take_objects(content, "images", "the file", path) if "images" in content else ()):
        if "width" in image and "height" in image:
            sizes[str(image.get("id"))] = _size_of(image, "width", "height", f"image {position}", path)
    found = take_objects(content, "annotations", "the file", path)
    entries = [(str(entry.get("image_id", path.stem)), entry) for entry in found]
    labels = read_categories(content, path, may_lack=True) if "categories" in content else ()
    if "img_width" in content and "img_height" in content:  # Grounded-SAM-2's picture
        sizes[path.stem] = _size_of(content, "img_width", "img_height", "the picture", path)
    own = {image: stem_of(take_text(entry, "file_name", "a detection", path)) for image, entry in entries
           if "file_name" in entry}  # fmt: skip
    return DetectionTable(path, entries, own | images_of(content, path), sizes, labels or None)


def _size_of(entry: dict[str, Any], width: str, height: str, context: str, path: Path) -> Size:
    size = take_whole_number(entry, width, context, path), take_whole_number(entry, height, context, path)
    check_picture(size, context, path)
    return size


def _masklets(frames: list[Any], path: Path) -> DetectionTable:
    """Return the table of an SA-V file, which holds for each frame the run lengths of each object in turn."""
    entries = []
    for position, objects in enumerate(frames):
        if not isinstance(objects, list):
            raise wrong_type("masklet", "a list of lists", objects, "the file", path)
        for track, runs in enumerate(objects, start=1):
            entries.append((str(position), {"segmentation": runs, "track": track}))
    return DetectionTable(path, entries, video_frames=len(frames))


def is_detections(place: Path) -> bool:
    """Whether a file, or the first in a folder of JSON files, has detections, judged without parsing the JSON."""
    if place.is_dir():
        named = sorted(path for path in shown_files(place) if path.name != "classes.toml")
        return bool(named) and all(path.suffix == ".json" for path in named) and is_detections(named[0])
    if place.suffix.lower() != ".json" or not place.is_file() or place.stat().st_size > LARGEST_TABLE:
        return False
    data = place.read_bytes()
    return b'"segments_info"' not in data and (b'"segmentation"' in data or b'"masklet"' in data)


def _read(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    table = read_table(place)
    found, warnings = table.of_frames(dict.fromkeys(names), {}, progress)
    classless = all(one.label is None for each in found.values() for one in each)
    sizes = {one.size for each in found.values() for one in each}
    masks = {}
    by_number = table.is_by_number(names)
    for name in names:  # a frame without detections gets an empty mask
        detected = found.get(name, ())
        own = {one.size for one in detected} or sizes
        if not detected and (by_number or len(sizes) > 1):
            continue  # it lacks a mask: the file counts otherwise, or nobody knows the mask's size
        if len(own) > 1:
            raise PlgsError("other-size", f"detections of frame {name} are of pictures of several sizes", place, _FIX)
        if own:
            size = next(iter(own))
            masks[name] = StoredMask(place, size, partial(_painted, place, detected, size))
    return MaskSource(masks, table.labels, warnings, tells_no_class=classless, void=frozenset())


def _painted(path: Path, detected: Sequence[DetectedSegment], size: Size) -> FoundMask:
    segments = [
        FoundSegment(number, one.track or 0 if one.label is None else one.label, one.score, track=one.track)
        for number, one in enumerate(detected, start=1)
    ]
    return painted((one.inside(path) for one in detected), segments, size)


FORMAT = MaskFormat("coco-detections", is_detections, _read, own_names=True)
