"""``evaluate``: what a finished lift's metrics say."""

from __future__ import annotations

from pathlib import Path

from ..job import ExitCode, LiftFolder, verify
from ..job.report import class_tables, metrics_table


def evaluate(path: Path, *, per_class: bool) -> ExitCode:
    """Check the files against the manifest, then print the tables. Raises JobError when the lift is not whole."""
    lift = LiftFolder.open(path)
    verify(lift.result_path)
    print(metrics_table(lift))
    if per_class:
        print("", class_tables(lift), sep="\n")
    return ExitCode.FINISHED
