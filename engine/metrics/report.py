"""Collects the scores of a lift, or of any program's label folders, in the form of metrics.json."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.layout import same_shape, shown_size
from ..scene import ClassTable, Frame, GroundTruth, Scene, Size, size_within
from ..scene.label_folders import LabelFolder, in_one_table
from ..scene.pixels import numbered_labels, resize_nearest
from .images import DepthErrors, PictureScores, score_picture
from .panoptic import MODES, FrameQuality, IdChanges, PanopticEvaluation

FORMAT = 1
INPUT_MASKS = "input masks"
LIFTED = "lifted"
METHODS = (INPUT_MASKS, LIFTED)
"""Methods in the order of their tables. Other methods follow."""

_FOLLOWED = ("pq_frame", "id_changes")
_NO_LABEL_SCORES: dict[str, object] = {
    "per_class": [],
    **dict.fromkeys(("mode", "miou", "miou_true", "pq", "sq", "rq", *_FOLLOWED)),
}


@dataclass(frozen=True, eq=False)
class PredictedView:
    """What a method predicts for a frame, at the frame's size. ``semantic``, ``instance``: ids, int32 [H, W], 0 = void,
    none. ``image`` [H, W, 3]: uint8 or floats in [0, 1], sRGB; None if it renders no picture. ``depth`` (planar,
    metres) and ``alpha`` (coverage, 0 to 1): float32 [H, W]; None if it renders no depth."""

    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]
    image: NDArray[np.generic] | None = None
    depth: NDArray[np.float32] | None = None
    alpha: NDArray[np.float32] | None = None


class _Labels:
    """The evaluations of one method's labels: PQ-scene in both modes, PQ frame by frame, and changes of ids."""

    def __init__(self, classes: ClassTable) -> None:
        self.modes = {mode: PanopticEvaluation(classes, mode) for mode in MODES}
        self.frames, self.ids = FrameQuality(classes), IdChanges(classes)

    def add(self, view: PredictedView, truth: GroundTruth) -> None:
        maps = (view.semantic, view.instance, truth.semantic, truth.instance)
        shared = {mode: evaluation.add(*maps) for mode, evaluation in self.modes.items()}
        self.frames.add(shared["strict"])
        self.ids.add(shared["strict"])

    def followed(self) -> dict[str, float | None]:
        return dict(zip(_FOLLOWED, (self.frames.pq, self.ids.per_object), strict=True))


class Report:
    """Scores the views of one or more methods, and makes the tables of metrics.json."""

    def __init__(self, classes: ClassTable) -> None:
        self.classes = classes
        self._labels: dict[str, _Labels] = {}
        self._pictures: dict[str, list[PictureScores]] = {}
        self._depths: dict[str, DepthErrors] = {}
        self._frames: list[str] = []

    def add(self, method: str, frame: Frame, view: PredictedView) -> None:
        """Score one held-out view of a ``method`` at its own size: labels if the frame has ground truth, picture and
        depth if the frame has them. Raises PlgsError if a file is bad."""
        height, width = view.semantic.shape
        size = width, height
        if frame.name not in self._frames:
            self._frames.append(frame.name)
        if view.image is not None:
            scores = score_picture(view.image, frame.read_colour(size))
            self._pictures.setdefault(method, []).append(scores)
        if view.depth is not None and view.alpha is not None:
            errors = self._depths.setdefault(method, DepthErrors())
            errors.add(view.depth, view.alpha, frame.depth(size))
        if frame.read_ground_truth is not None:
            self.add_labels(method, frame.name, view, frame.read_ground_truth(size))

    def add_labels(self, method: str, frame: str, view: PredictedView, truth: GroundTruth) -> None:
        """Score a ``method``'s labels of one view. Raises ValueError if they differ in size from the ground truth."""
        if frame not in self._frames:
            self._frames.append(frame)
        if method not in self._labels:
            self._labels[method] = _Labels(self.classes)
        self._labels[method].add(view, truth)

    def to_json(self) -> dict[str, object]:
        """Return the content of metrics.json: shares in [0, 1], decibels, metres; null for what was not measured."""
        known = {*self._labels, *self._pictures, *self._depths}
        methods = [*(name for name in METHODS if name in known), *sorted(known.difference(METHODS))]
        return {
            "format": FORMAT,
            "test_frames": list(self._frames),
            "tables": [table for method in methods for table in self._tables(method)],
        }

    def _tables(self, method: str) -> Iterator[dict[str, object]]:
        """Yield a method's tables: one per mode or, if no labels were scored, one table without a mode."""
        errors = self._depths.get(method, DepthErrors())
        depth = {"depth_error_m": errors.median}
        pictures = self._pictures.get(method, [])  # the means over the views
        means = [sum(of_views) / len(pictures) for of_views in zip(*pictures, strict=True)]
        names = PictureScores._fields
        rendered = {**(dict(zip(names, means, strict=True)) if pictures else dict.fromkeys(names)), **depth}
        labels = self._labels.get(method)
        scores = [] if labels is None else [one.result() for one in labels.modes.values() if not one.is_empty]
        for score in scores:
            assert labels is not None
            rows = [asdict(row) for row in score.per_class]
            followed = labels.followed() if score.mode == "strict" else dict.fromkeys(_FOLLOWED)
            yield {"name": method, **asdict(score), "per_class": rows, **followed, **rendered}
        if not scores and any(value is not None for value in rendered.values()):
            yield {"name": method, **_NO_LABEL_SCORES, **rendered}


def add_input_masks(report: Report, scene: Scene, within: Size | None = None) -> None:
    """Score the input masks of the held-out frames that have ground truth, as a method of its own, at a size that fits
    ``within`` (None: their own). Raises PlgsError if a file is bad."""
    first_id = 1
    for frame in scene.test_frames:
        if frame.read_ground_truth is not None:
            mask = frame.mask(frame.size if within is None else size_within(frame.size, within))
            values, index = numbered_labels(mask.ids)
            # The ids of different views are unrelated, so each view gets fresh ones.
            fresh = np.where(values > 0, np.cumsum(values > 0) + first_id - 1, 0).astype(np.int32)
            first_id = max(first_id, int(fresh.max(initial=0)) + 1)
            report.add(INPUT_MASKS, frame, PredictedView(mask.class_map(), fresh[index.reshape(mask.ids.shape)]))


PREDICTIONS = "predictions"


def score_folders(predictions: LabelFolder, truth: LabelFolder, *, ids_per_frame: bool = False) -> dict[str, object]:
    """Return the scores of all predicted frames, in the form of metrics.json. Each needs ground truth, to whose size it
    is resized. ``ids_per_frame``: instance ids are valid only within a frame, as a detector gives them. Raises
    PlgsError if a file is bad, or shows a different crop of the picture."""
    unknown = [name for name in predictions.readers if name not in truth.readers]
    if unknown:
        what = f"{len(unknown)} predicted frames have no ground truth, such as {unknown[0]}"
        fix = "Give a frame's images the same name in both folders, or remove these."
        raise PlgsError("no-truth", what, truth.folder, fix)
    classes, predictions = in_one_table(predictions, truth)
    report, next_id = Report(classes), 0
    for name, read in predictions.readers.items():
        predicted, true = read(), truth.readers[name]()
        height, width = true.semantic.shape
        size = width, height
        if not same_shape((predicted.semantic.shape[1], predicted.semantic.shape[0]), size):
            what = f"frame {name} and its ground truth of {shown_size(size)} have different shapes"
            fix = "Resize predictions of whole pictures to their ground truth's shape."
            raise PlgsError("truth-shape", what, predictions.folder, fix)
        semantic, instance = resize_nearest(predicted.semantic, size), resize_nearest(predicted.instance, size)
        if ids_per_frame:
            instance = instance + (instance > 0) * next_id
            next_id = max(next_id, int(instance.max(initial=0)))
        report.add_labels(PREDICTIONS, name, PredictedView(semantic, instance.astype("int32")), true)
    return report.to_json()


def unscored(predictions: LabelFolder, truth: LabelFolder) -> int:
    """Return how many frames of the ``truth`` have no prediction."""
    return len(truth.readers.keys() - predictions.readers.keys())
