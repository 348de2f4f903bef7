"""``experiments``: the figures of many scenes in one table."""

from __future__ import annotations

import argparse

from ..experiments import Experiment, read_results, run_experiment, scenes_from
from ..job.terminal import Interrupted, Interrupts


def experiments(options: argparse.Namespace) -> int:
    """Lift the scenes, one process each, and print the table. Raises JobError, SceneError."""
    experiment = Experiment(
        scenes=scenes_from(options.scenes, options.names),
        folder=options.output,
        preset=options.preset,
        steps=options.steps,
        seed=options.seed,
        earlier=read_results(options.against) if options.against else (),
    )
    try:
        with Interrupts() as interrupts:
            return run_experiment(experiment, interrupts)
    except Interrupted as error:
        return error.exit_code
