"""What is a lift worth on many scenes? Lifts them one after the other and puts their figures into one table."""

from __future__ import annotations

from .results import read_results
from .run import Experiment, run_experiment
from .scenes import SceneToLift, scenes_from

__all__ = ["Experiment", "SceneToLift", "read_results", "run_experiment", "scenes_from"]
