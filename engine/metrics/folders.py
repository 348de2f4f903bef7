"""Scores of labels in folders, made by any program."""

from __future__ import annotations

from ..errors import PlgsError
from ..posed.layout import same_shape, shown_size
from ..scene.label_folders import LabelFolder, in_one_table
from ..scene.pixels import resize_nearest
from .report import PredictedView, Report

PREDICTIONS = "predictions"


def score_folders(predictions: LabelFolder, truth: LabelFolder, *, ids_per_frame: bool = False) -> dict[str, object]:
    """The scores of all predicted frames, in the form of metrics.json. All of them need ground truth.

    ``ids_per_frame``: an instance id is valid only within its frame, like a detector's. Predictions are resized to the
    ground truth. Raises PlgsError if a file is bad, or shows another cut of the picture.
    """
    unknown = [name for name in predictions.readers if name not in truth.readers]
    if unknown:
        what = f"{len(unknown)} predicted frames have no ground truth, such as {unknown[0]}"
        raise PlgsError(what, truth.folder, "Give a frame's images the same name in both folders, or remove these.")
    classes, predictions = in_one_table(predictions, truth)
    report, next_id = Report(classes), 0
    for name, read in predictions.readers.items():
        predicted, true = read(), truth.readers[name]()
        height, width = true.semantic.shape
        size = width, height
        if not same_shape((predicted.semantic.shape[1], predicted.semantic.shape[0]), size):
            what = f"frame {name} has another shape than its ground truth of {shown_size(size)}"
            fix = "Resize predictions of whole pictures to their ground truth's shape."
            raise PlgsError(what, predictions.folder, fix)
        semantic, instance = resize_nearest(predicted.semantic, size), resize_nearest(predicted.instance, size)
        if ids_per_frame:
            instance = instance + (instance > 0) * next_id
            next_id = max(next_id, int(instance.max(initial=0)))
        report.add_labels(PREDICTIONS, name, PredictedView(semantic, instance.astype("int32")), true)
    return report.to_json()


def unscored(predictions: LabelFolder, truth: LabelFolder) -> int:
    """The number of frames with ground truth that are not predicted."""
    return len(truth.readers.keys() - predictions.readers.keys())
