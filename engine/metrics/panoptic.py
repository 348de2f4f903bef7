"""mIoU and PQ-scene of predicted views against ground truth, in two modes.

``pl_compat`` reproduces the evaluator behind the published numbers of Panoptic Lifting, Contrastive Lift and PLGS, with
its peculiarities: every map is stretched to 512x512, rare classes are dropped, and predicted void is scored as a class
of its own. ``strict`` uses the native resolution and drops no class; predicted void is a miss but never a class.

Both first remove the pixels whose ground truth is void. Both count a segment as a distinct (class, instance) pair over
ALL views (PQ-scene), so an object that changes its id between views is wrong. How good single frames are, and how often
objects change their ids, ``FrameQuality`` and ``IdChanges`` tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..scene import VOID, ClassTable
from ..scene.pixels import distinct_ids, numbered_labels, resize_nearest

Mode = Literal["strict", "pl_compat"]
MODES: tuple[Mode, ...] = get_args(Mode)

COMPAT_SIZE = (512, 512)
RARE = 0.005
"""pl_compat drops classes with less than this share of the pixels that have ground truth."""

Segment = tuple[int, int]
"""(class id, instance id)."""
Pair = tuple[Segment, Segment]
"""(predicted segment, true segment)."""


@dataclass(frozen=True)
class ClassScore:
    """One class's scores in [0, 1], None where not part of the mean: IoU; panoptic quality ``pq``, the product of
    segmentation (``sq``) and recognition quality (``rq``). ``tp``, ``fp``, ``fn``: matched, wrong, missed segments."""

    class_id: int
    name: str
    iou: float | None
    pq: float | None
    sq: float | None
    rq: float | None
    tp: int
    fp: int
    fn: int


@dataclass(frozen=True)
class PanopticScores:
    """Means over classes, each in [0, 1]: IoU, panoptic, segmentation and recognition quality; and the classes that
    they include, by ascending id. ``miou_true``: the mean IoU over only the classes that the ground truth has, as is
    common in the field. A class that is wrongly predicted then costs only the pixels that it takes from true
    classes."""

    mode: Mode
    miou: float
    miou_true: float
    pq: float
    sq: float
    rq: float
    per_class: tuple[ClassScore, ...]


class PanopticEvaluation:
    """Accumulates views one by one, as the number of ``pixels`` that each predicted and each true segment share."""

    def __init__(self, classes: ClassTable, mode: Mode) -> None:
        if mode not in MODES:
            raise ValueError(f"unknown mode {mode!r}: choose one of {', '.join(MODES)}")
        self.classes = classes
        self.mode: Mode = mode
        self.pixels: Counter[Pair] = Counter()

    def add(
        self,
        pred_semantic: NDArray[np.integer],
        pred_instance: NDArray[np.integer],
        gt_semantic: NDArray[np.integer],
        gt_instance: NDArray[np.integer],
    ) -> dict[Pair, int]:
        """Count a view, given as predicted and true class ids (semantic) and instance ids, integers [H, W], 0 = none.
        Return its numbers of shared pixels, by pair of segments. Classes that are not in the table count as void.
        Raises ValueError if an id is negative, or if shapes differ; in ``pl_compat`` prediction and ground truth may
        have different sizes."""
        maps = [np.asarray(m) for m in (pred_semantic, pred_instance, gt_semantic, gt_instance)]
        if self.mode == "pl_compat":
            maps = [resize_nearest(m, COMPAT_SIZE) for m in maps]
        if len({m.shape for m in maps}) != 1:
            shapes = ", ".join(str(m.shape) for m in maps)
            raise ValueError(f"prediction and ground truth differ in size: {shapes}")
        predicted, true = self._segments(maps[0], maps[1]), self._segments(maps[2], maps[3])
        valid = (true >> 32) != VOID
        p_values, p_index = numbered_labels(predicted[valid])
        t_values, t_index = numbered_labels(true[valid])
        pairs, pixels = distinct_ids(p_index * max(len(t_values), 1) + t_index)
        shared = {
            (_unpack(int(p_values[k // len(t_values)])), _unpack(int(t_values[k % len(t_values)]))): int(n)
            for k, n in zip(pairs.tolist(), pixels.tolist(), strict=True)
        }
        self.pixels.update(shared)
        return shared

    @property
    def is_empty(self) -> bool:
        """Whether no pixel with ground truth has been added yet."""
        return not self.pixels

    def _segments(self, semantic: NDArray[np.integer], instance: NDArray[np.integer]) -> NDArray[np.int64]:
        """Pack class and instance of each pixel into one int64, as a flat array; stuff gets no instance."""
        if semantic.size and min(int(semantic.min()), int(instance.min())) < 0:
            raise ValueError("class and instance ids must not be negative")
        known = np.isin(semantic, self.classes.ids)
        things = np.isin(semantic, sorted(self.classes.thing_ids))
        packed = np.where(known, semantic, VOID).astype(np.int64) << 32
        return (packed | np.where(things, instance, 0).astype(np.int64)).ravel()

    def result(self) -> PanopticScores:
        """Return the scores of all views added so far. Raises ValueError if no pixel had ground truth."""
        if self.is_empty:
            raise ValueError("nothing to score: no pixel has ground truth")
        ids = (VOID, *self.classes.ids)
        areas = _ClassAreas.of(self.pixels)
        in_miou = {c for c in ids if areas.is_kept(c, self.mode, for_pq=False)}
        in_pq = {c for c in ids if areas.is_kept(c, self.mode, for_pq=True)}
        matches = _match(self.pixels, in_pq, excuse_void=self.mode == "pl_compat")
        rows = tuple(
            matches.score(
                class_id=c,
                name="void" if c == VOID else self.classes[c].name,
                iou=areas.iou(c) if c in in_miou else None,
                is_kept=c in in_pq,
            )
            for c in ids
            if c in in_miou or c in in_pq
        )
        return PanopticScores(
            mode=self.mode,
            miou=_mean(row.iou for row in rows),
            miou_true=_mean(row.iou for row in rows if areas.true[row.class_id]),
            pq=_mean(row.pq for row in rows),
            sq=_mean(row.sq for row in rows),
            rq=_mean(row.rq for row in rows),
            per_class=rows,
        )


@dataclass(frozen=True)
class _ClassAreas:
    """The pixels of each class in the prediction, the ground truth and both at once, and their number in ``total``."""

    predicted: Counter[int]
    true: Counter[int]
    both: Counter[int]
    total: int

    @classmethod
    def of(cls, pixels: Counter[Pair]) -> _ClassAreas:
        predicted, true, both = Counter[int](), Counter[int](), Counter[int]()
        for ((pred_class, _), (true_class, _)), n in pixels.items():
            predicted[pred_class] += n
            true[true_class] += n
            if pred_class == true_class:
                both[true_class] += n
        return cls(predicted, true, both, sum(pixels.values()))

    def iou(self, class_id: int) -> float:
        shared = self.both[class_id]
        return shared / (self.predicted[class_id] + self.true[class_id] - shared)

    def is_kept(self, class_id: int, mode: Mode, for_pq: bool) -> bool:
        predicted, true = self.predicted[class_id] / self.total, self.true[class_id] / self.total
        if mode == "strict":
            return class_id != VOID and (predicted > 0 or true > 0)
        if not for_pq:
            return predicted >= RARE or true >= RARE
        # As in the original, a class predicted on 0.3 % is dropped, while one predicted nowhere stays and scores 0.
        rare = 0 < predicted < RARE or 0 < true < RARE
        return (predicted > 0 or true > 0) and not rare


@dataclass(frozen=True)
class _Matches:
    """By class: the sum of matched pairs' IoU; the numbers of matched (``tp``), wrong and missed segments."""

    iou: dict[int, float]
    tp: Counter[int]
    fp: Counter[int]
    fn: Counter[int]

    def score(self, class_id: int, name: str, iou: float | None, is_kept: bool) -> ClassScore:
        """Return a class's scores: SQ = sum IoU / TP, RQ = TP / (TP + FP/2 + FN/2), PQ = SQ * RQ; 0 if undefined."""
        if not is_kept:
            return ClassScore(class_id, name, iou, None, None, None, 0, 0, 0)
        tp, fp, fn = self.tp[class_id], self.fp[class_id], self.fn[class_id]
        weight = tp + 0.5 * fp + 0.5 * fn
        sq = self.iou[class_id] / tp if tp else 0.0
        rq = tp / weight if weight else 0.0
        return ClassScore(class_id, name, iou, sq * rq, sq, rq, tp, fp, fn)


def _match(pixels: Counter[Pair], kept: set[int], *, excuse_void: bool) -> _Matches:
    """Match segments of a class whose IoU exceeds 0.5 (so each has at most one partner). With ``excuse_void``, pixels
    whose label on the other side is not a ``kept`` class do not count in the union, and a segment with more than half
    of its area there is no error. Otherwise predicted void is an ordinary miss."""
    predicted, true = Counter[Segment](), Counter[Segment]()
    predicted_on_void, true_on_void = Counter[Segment](), Counter[Segment]()
    for (p, t), n in pixels.items():
        predicted[p] += n
        true[t] += n
        if excuse_void and t[0] not in kept:
            predicted_on_void[p] += n
        if excuse_void and p[0] not in kept:
            true_on_void[t] += n
    matches = _Matches({}, Counter(), Counter(), Counter())
    matched: set[tuple[str, Segment]] = set()
    for (p, t), n in pixels.items():
        if p[0] != t[0] or p[0] not in kept:
            continue
        union = predicted[p] - predicted_on_void[p] + true[t] - true_on_void[t] - n
        if n > 0.5 * union:
            matches.iou[p[0]] = matches.iou.get(p[0], 0.0) + n / union
            matches.tp[p[0]] += 1
            matched |= {("predicted", p), ("true", t)}
    sides = ("predicted", predicted, predicted_on_void, matches.fp), ("true", true, true_on_void, matches.fn)
    for side, segments, on_void, errors in sides:
        for one, area in segments.items():
            if one[0] in kept and (side, one) not in matched and on_void[one] <= 0.5 * area:
                errors[one[0]] += 1
    return matches


def _unpack(packed: int) -> Segment:
    return packed >> 32, packed & 0xFFFFFFFF


def _mean(values: Iterable[float | None]) -> float:
    """Return the mean of the values that are not None; 0 if there are none."""
    kept = [value for value in values if value is not None]
    return sum(kept) / len(kept) if kept else 0.0


class FrameQuality:
    """COCO's panoptic quality: segments are matched in each frame, so ids need not agree across frames. Matches and
    errors are counted over all frames, and PQ is the mean over classes. Void is treated as in ``strict``."""

    def __init__(self, classes: ClassTable) -> None:
        self.classes = classes
        self._iou: dict[int, float] = {}
        self._matched: Counter[int] = Counter()
        self._errors: Counter[int] = Counter()

    def add(self, pixels: Mapping[Pair, int]) -> None:
        """Count a frame, given as the number of pixels that each predicted and true segment share, from
        ``PanopticEvaluation.add`` in the mode ``strict``."""
        if not pixels:
            return
        frame = PanopticEvaluation(self.classes, "strict")
        frame.pixels.update(pixels)
        for row in frame.result().per_class:
            self._iou[row.class_id] = self._iou.get(row.class_id, 0.0) + (row.sq or 0.0) * row.tp
            self._matched[row.class_id] += row.tp
            self._errors[row.class_id] += row.fp + row.fn

    @property
    def pq(self) -> float | None:
        """The panoptic quality in [0, 1]; None before any pixel had ground truth."""
        if not self._iou:
            return None
        each = [iou / (self._matched[row] + 0.5 * self._errors[row]) for row, iou in self._iou.items()]
        return sum(each) / len(each)


class IdChanges:
    """Counts how often true objects change their predicted id over the frames, in order. An object is tracked in a
    frame if a predicted segment of its class has an IoU above 0.5 with it; its id changes if that segment's id differs
    from the one in the last frame in which it was tracked."""

    def __init__(self, classes: ClassTable) -> None:
        self.classes = classes
        self._last: dict[Segment, int] = {}
        self._tracked: Counter[Segment] = Counter()
        self._changes: Counter[Segment] = Counter()

    def add(self, pixels: Mapping[Pair, int]) -> None:
        """Count the next frame: the number of pixels that each predicted and true segment share."""
        predicted, true = Counter[Segment](), Counter[Segment]()
        for (p, t), shared in pixels.items():
            predicted[p] += shared
            true[t] += shared
        for (p, t), shared in pixels.items():
            is_object = p[0] == t[0] and t[0] in self.classes.thing_ids and t[1] != 0
            if not is_object or 2 * shared <= predicted[p] + true[t] - shared:
                continue
            self._tracked[t] += 1
            self._changes[t] += t in self._last and self._last[t] != p[1]
            self._last[t] = p[1]

    @property
    def per_object(self) -> float | None:
        """The mean number of changes per object, over those tracked in two or more frames; None if there are none."""
        again = [one for one, frames in self._tracked.items() if frames > 1]
        return sum(self._changes[one] for one in again) / len(again) if again else None
