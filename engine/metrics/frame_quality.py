"""Two things that PQ-scene does not separate: how good single frames are, and how often an object changes its id."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from ..scene import ClassTable
from .panoptic import Pair, PanopticEvaluation, Segment


class FrameQuality:
    """COCO's panoptic quality: segments are matched frame by frame, so ids need not agree across frames. True and
    false ones are counted over all frames, and PQ is the mean over the classes. Void is treated as in ``strict``."""

    def __init__(self, classes: ClassTable) -> None:
        self.classes = classes
        self._iou: dict[int, float] = {}
        self._matched: Counter[int] = Counter()
        self._errors: Counter[int] = Counter()

    def add(self, pixels: Mapping[Pair, int]) -> None:
        """Count one view: how many pixels each predicted and true segment share, as returned by
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
        """PQ in [0, 1]; None before any pixel had ground truth."""
        if not self._iou:
            return None
        each = [iou / (self._matched[row] + 0.5 * self._errors[row]) for row, iou in self._iou.items()]
        return sum(each) / len(each)


class IdChanges:
    """Follows every true object over the frames in order. It is tracked in a frame if a predicted segment of its class
    has an IoU above 0.5 with it. It has changed its id if this segment's id differs from that of the segment in which
    it was last tracked."""

    def __init__(self, classes: ClassTable) -> None:
        self.classes = classes
        self._last: dict[Segment, int] = {}
        self._tracked: Counter[Segment] = Counter()
        self._changes: Counter[Segment] = Counter()

    def add(self, pixels: Mapping[Pair, int]) -> None:
        """Count the next view, like ``FrameQuality.add``."""
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
        """The mean number of changes of the objects tracked in two or more frames; None if there are none."""
        again = [one for one, frames in self._tracked.items() if frames > 1]
        return sum(self._changes[one] for one in again) / len(again) if again else None
