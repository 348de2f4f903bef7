"""Compare detections with the masks that they cover, before any of them votes: to which frames they belong, if their
ids can be read in two ways, and of which table their class numbers are, if their file names no classes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..errors import PlgsError
from ..posed.classes import ClassLabel
from .class_map import plain_name
from .class_tables import TABLES, base_of, known_table, numberings_of
from .frame import Inferred
from .frame_choice import evenly_spread
from .mask_formats import MaskSource
from .overlapping import Detections

_FRAMES, _DETECTIONS = 8, 60  # maximum numbers of frames and of detections of each that are compared
_ENOUGH, _TIMES = 0.3, 2.0
"""A table is recognised if this fraction of what detections cover has their class in it, and this many times more than
with the masks' own numbers."""
_CLASSES = 3  # least classes that must agree with a table other than COCO's: one or two agree with some by chance
_HARDLY = 0.05  # a smaller fraction causes a warning
_MEND = "if that is wrong, name their table in a classes.toml beside them"


def fitted(
    detections: Detections, source: MaskSource, labels: Sequence[ClassLabel]
) -> tuple[Detections, tuple[Inferred, ...]]:
    """Return the detections as read in the way that fits the masks of ``source`` best, and what was inferred.
    ``labels`` are the masks' classes."""
    inferred = []
    covered, overlap = _compared(detections, source)
    if detections.otherwise is not None:
        other_covered, other_overlap = _compared(detections.otherwise, source)
        if other_overlap > overlap:
            detections, covered, overlap, other_overlap = detections.otherwise, other_covered, other_overlap, overlap
        whose = "in the masks' table" if detections.by_table else "in the frames' names"
        ids = f"image ids of the detections are the numbers {whose}"
        why = f"they overlap the masks' segments by {overlap:.0%} then, and by {other_overlap:.0%} otherwise"
        inferred.append(Inferred("detections' pictures", ids, why, is_doubtful=overlap < _TIMES * other_overlap))
    total = sum(covered.values())
    if detections.labels is not None or source.tells_no_class or not labels or not total:
        return detections, tuple(inferred)
    names = {label.id: plain_name(label.name) for label in labels}
    own = sum(pixels for (number, under), pixels in covered.items() if number == under) / total
    shares = {}
    for table in (each for base in TABLES for each in numberings_of(base)):
        known = {label.id: plain_name(label.name) for label in known_table(table).labels}
        same = {number: n for (number, under), n in covered.items() if known.get(number, "") == names.get(under)}
        is_enough = base_of(table) == "coco" or len(same) >= _CLASSES
        shares[table] = sum(same.values()) / total if is_enough else 0.0
    best = max(shares, key=lambda table: shares[table])
    if shares[best] >= _ENOUGH and shares[best] > _TIMES * own:
        detections = replace(detections, labels=known_table(best).labels)
        taken = f"the detections' numbers are read as {best}"
        why = f"{shares[best]:.0%} of what they cover has their class then, {own:.0%} with the masks' numbers; {_MEND}"
        inferred.append(Inferred("detections' numbers", taken, why))
    elif own < _HARDLY:
        taken = "the detections' numbers are read as the masks'"
        inferred.append(Inferred("detections' numbers", taken, f"only {own:.0%} of what they cover agrees; {_MEND}"))
    return detections, tuple(inferred)


def _compared(detections: Detections, source: MaskSource) -> tuple[Counter[tuple[int, int]], float]:
    """Return the number of pixels of each pair of a detection's class number and that of the mask below, and the mean
    overlap (intersection over union) of detections with the segments that fit them best."""
    covered, overlaps = Counter[tuple[int, int]](), []
    for name in evenly_spread([name for name in detections.found if name in source.masks], _FRAMES):
        ones = sorted(detections.found[name], key=lambda one: -one.score)[:_DETECTIONS]
        try:
            below = source.masks[name].read()
            size = below.ids.shape[1], below.ids.shape[0]
            pixels = [one.inside(detections.path, size) for one in ones]
        except PlgsError:  # the later reader reports the error
            continue
        areas = np.bincount(below.ids.ravel())
        for one, inside in zip(ones, pixels, strict=True):
            shared = np.bincount(below.ids[inside], minlength=len(areas))
            unions = np.count_nonzero(inside) + areas - shared
            overlaps.append(float((shared[1:] / np.maximum(unions[1:], 1)).max(initial=0.0)))
            if one.label is not None:
                for segment in below.segments:
                    if segment.id < len(shared) and shared[segment.id]:
                        covered[one.label, segment.label] += int(shared[segment.id])
    return covered, float(np.mean(overlaps)) if overlaps else 0.0
