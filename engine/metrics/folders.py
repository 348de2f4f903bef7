"""Scores of labels that lie in folders, made by whichever program."""

from __future__ import annotations

from ..scene import SceneError
from ..scene.label_folders import LabelFolder, common_classes
from .report import PredictedView, Report
from .resampling import nearest

PREDICTIONS = "predictions"


def score_folders(predictions: LabelFolder, truth: LabelFolder, *, ids_per_frame: bool = False) -> dict[str, object]:
    """As metrics.json has it, over the frames that are predicted; all of them need ground truth.

    ``ids_per_frame``: an instance id means something within its frame alone, as a detector's does. Predictions of
    another size take that of the ground truth. Raises SceneError when a file is bad.
    """
    unknown = [name for name in predictions.readers if name not in truth.readers]
    if unknown:
        what = f"{len(unknown)} predicted frames have no ground truth, {unknown[0]} among them"
        raise SceneError(what, truth.folder, "Call the images of a frame alike in both folders, or take these away.")
    report, next_id = Report(common_classes(predictions, truth)), 0
    for name, read in predictions.readers.items():
        predicted, true = read(), truth.readers[name]()
        height, width = true.semantic.shape
        semantic, instance = nearest(predicted.semantic, (width, height)), nearest(predicted.instance, (width, height))
        if ids_per_frame:
            instance = instance + (instance > 0) * next_id
            next_id = max(next_id, int(instance.max(initial=0)))
        report.add_labels(PREDICTIONS, name, PredictedView(semantic, instance.astype("int32")), true)
    return report.to_json()


def unscored(predictions: LabelFolder, truth: LabelFolder) -> int:
    """How many frames with ground truth are not predicted."""
    return len(truth.readers.keys() - predictions.readers.keys())
