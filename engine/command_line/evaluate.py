"""``evaluate``: what a finished lift's metrics say, or how good any labels in a folder are."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path

from ..job import ExitCode, LiftFolder, verify
from ..job.report import class_tables, classes_text, metrics_table, read_metrics, tables_text


def evaluate(path: Path, *, per_class: bool, as_json: bool) -> ExitCode:
    """Check the files against the manifest, then print the tables, or metrics.json in one line. Raises JobError when
    the lift is not whole."""
    lift = LiftFolder.open(path)
    verify(lift.result_path)
    if as_json:
        print(json.dumps(read_metrics(lift)))
        return ExitCode.FINISHED
    print(metrics_table(lift))
    if per_class:
        print("", class_tables(lift), sep="\n")
    return ExitCode.FINISHED


def evaluate_folders(
    predictions: Path, truth: Path, *, per_class: bool, ids_per_frame: bool, as_json: bool
) -> ExitCode:
    """Print the tables of labels against ground truth. Raises SceneError when either cannot be read."""
    from ..metrics.folders import score_folders, unscored
    from ..scene.label_folders import open_label_folder

    predicted, true = open_label_folder(predictions, is_truth=False), open_label_folder(truth, is_truth=True)
    scores = score_folders(predicted, true, ids_per_frame=ids_per_frame)
    left = unscored(predicted, true)
    if left:
        print(f"{left} frames with ground truth are not predicted: they are not scored.", file=sys.stderr)
    if as_json:
        print(json.dumps(scores))
        return ExitCode.FINISHED
    listed = scores["tables"]
    assert isinstance(listed, list)
    tables: list[Mapping] = listed
    print(tables_text(tables))
    if per_class:
        print("", classes_text(tables), sep="\n")
    return ExitCode.FINISHED
