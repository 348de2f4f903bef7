"""What is a lift worth, and each of its parts? Lifts scenes in many ways, one after the other, and tells in tables."""

from __future__ import annotations

from .figures import Figures, Result
from .results import read_results
from .rows import Row, Rows, read_rows
from .run import Experiment, run_experiment
from .scenes import SceneToLift, scenes_from
from .table import Tables

__all__ = [
    "Experiment",
    "Figures",
    "Result",
    "Row",
    "Rows",
    "SceneToLift",
    "Tables",
    "read_results",
    "read_rows",
    "run_experiment",
    "scenes_from",
]
