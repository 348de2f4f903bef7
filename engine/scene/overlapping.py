"""Detections over a scene's masks: segments of a frame that may overlap each other and the masks below them. A panoptic
picture has one segment per pixel, so it loses what the network was less sure of, such as a pillow on a bed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..job.progress import Progress, unwatched
from ..json_file import read_json_object
from ..posed.classes import VOID, ClassLabel
from ..posed.layout import fits_picture, listed, shown_size
from .class_choice import find_class_choice
from .class_map import ClassMap, plain_name
from .frame import Evidence, Segment, Size
from .mask_formats.coco import images_of
from .mask_formats.coco_results import DetectedSegment, DetectionTable, read_table

TABLE = "panoptic.json"  # the file name of the masks' table, which may name pictures by id
LEAST_SCORE = 0.1  # minimum score of a detection; weak detections are evidence, too
_FIX = "Name their classes under categories, or name the table of their numbers in a classes.toml beside them."


@dataclass(frozen=True)
class EvidenceReader:
    """Reads one frame's detections ``found`` from the file ``path``. ``own`` is the frame's size (width, height), and
    ``number_of`` maps their labels to class numbers in ``known``."""

    path: Path
    own: Size
    found: tuple[DetectedSegment, ...]
    number_of: Mapping[int, int]
    known: ClassMap

    def __call__(self, size: Size | None = None) -> Evidence:
        """Read the detections at ``size`` or the frame's own. Detections of the same pixels share one vote by score."""
        width, height = size or self.own
        total: dict[bytes, float] = {}
        for one in self.found:
            total[one.runs] = total.get(one.runs, 0.0) + one.score
        segments: list[Segment] = []
        inside = np.zeros((len(self.found), height, width), bool)
        for one in self.found:
            class_id = VOID if one.label is None else self.known.class_of.get(self.number_of[one.label], VOID)
            pixels = one.inside(self.path, (width, height))
            if class_id != VOID and pixels.any():
                inside[len(segments)] = pixels
                is_thing = self.known.classes[class_id].is_thing
                number, share = len(segments) + 1, one.score / total[one.runs]
                segments.append(Segment(number, class_id, is_thing, one.score, track=one.track, share=share))
        return Evidence(tuple(segments), inside[: len(segments)])

    def digest(self) -> str:
        """The start of the SHA-256 of the detections and of how they are read."""
        read_as = {label: self.known.class_of.get(number) for label, number in self.number_of.items()}
        return sha256(repr((self.found, sorted(read_as.items()))).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Detections:
    """The detections ``found`` by frame, the frames' ``sizes`` (width, height), and the ``labels``, None if unnamed. If
    the detections' picture ids can be read in two ways, ``by_table`` says whether they were taken for ids of the masks'
    table, and ``otherwise`` are the detections as read the other way."""

    path: Path
    sizes: Mapping[str, Size]
    found: Mapping[str, tuple[DetectedSegment, ...]]
    labels: tuple[ClassLabel, ...] | None
    warnings: tuple[str, ...] = ()
    by_table: bool = False
    otherwise: Detections | None = None

    def joined(self, labels: Sequence[ClassLabel]) -> tuple[dict[int, int], tuple[ClassLabel, ...]]:
        """Map each label of the detections to the masks' label of the same name. Returns this mapping, and the classes
        that the masks' ``labels`` lack, with free numbers. Raises PlgsError if a number's meaning is unknown."""
        used = sorted({one.label for each in self.found.values() for one in each if one.label is not None})
        if not used and any(self.found.values()):
            raise PlgsError("no-class-names", "the detections have no classes", self.path, _FIX, option="--detections")
        own = labels if self.labels is None else self.labels
        name_of = {label.id: label for label in own}
        unknown = [number for number in used if number not in name_of]
        if unknown:
            what = f"detections have class ids that nothing names ({listed(unknown)})"
            raise PlgsError("unknown-classes", what, self.path, _FIX, option="--detections")
        if self.labels is None:
            return {number: number for number in used}, ()
        number_of = {plain_name(label.name): label.id for label in reversed(labels)}  # of equal names, the first
        more: list[ClassLabel] = []
        free = max((label.id for label in labels), default=0) + 1
        for number in used:
            word = plain_name(name_of[number].name)
            if word not in number_of:
                number_of[word] = free + len(more)
                more.append(replace(name_of[number], id=number_of[word], colour=None))
        return {number: number_of[plain_name(name_of[number].name)] for number in used}, tuple(more)


def open_detections(path: Path, masks: Path, sizes: Mapping[str, Size], progress: Progress = unwatched) -> Detections:
    """Open the detections in ``path``, over ``masks``, for frames of these ``sizes``. Raises PlgsError for none."""
    folder = masks if masks.is_dir() else masks.parent
    if not path.exists():
        raise PlgsError("no-detections", "there are no detections", path, "Name a JSON file.", option="--detections")
    table, panoptic = read_table(path), folder / TABLE
    images = images_of(read_json_object(panoptic), panoptic) if panoptic.is_file() else {}
    first = _open(table, sizes, images, labels=_labels(table, folder), progress=progress)
    if not images or table.names:
        return first
    by_number = _open(table, sizes, {}, labels=first.labels)
    return first if by_number.found == first.found else replace(first, by_table=True, otherwise=by_number)


def _labels(table: DetectionTable, masks: Path) -> tuple[ClassLabel, ...] | None:
    """Return the classes that the file or a classes.toml beside it (not the masks' own) names; None without either."""
    path, labels = table.path, table.labels
    choice = find_class_choice(None, path.parent) if path.parent != masks else None
    if labels is None and choice is not None:
        rows = (row for row in choice.rows if row.id is not None)
        named_rows = (ClassLabel(row.id or 0, row.into or row.name or "", row.thing is not False) for row in rows)
        labels = (*(choice.labels or ()), *(label for label in named_rows if label.name))
    return labels


def _open(
    table: DetectionTable, sizes: Mapping[str, Size], images: Mapping[str, str],
    *, labels: tuple[ClassLabel, ...] | None, progress: Progress = unwatched,
) -> Detections:  # fmt: skip
    path = table.path
    found, warnings = table.of_frames(sizes, images, progress)
    for name, each in found.items():
        for one in each:
            if not fits_picture(one.size, sizes[name]):
                what = f"a detection in {shown_size(one.size)} does not fit frame {name} of {shown_size(sizes[name])}"
                raise PlgsError("mask-shape", what, path, "Give detections of these pictures.", option="--detections")
    kept = {name: tuple(one for one in each if one.score >= LEAST_SCORE) for name, each in found.items()}
    return Detections(path, sizes, kept, labels, warnings)
