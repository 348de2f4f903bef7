"""``experiments``: the figures of many lifts in tables."""

from __future__ import annotations

import argparse
import sys

from ..experiments import Experiment, Rows, read_results, read_rows, run_experiment, scenes_from
from ..job import ExitCode, JobError
from ..job.terminal import Interrupted, Interrupts

SAMPLE = "sample/room"


def experiments(options: argparse.Namespace) -> int:
    """Run the rows, one process each, and print the tables. Raises JobError, SceneError."""
    rows = read_rows()
    if options.list:
        print(*_listed(rows), sep="\n")
        return ExitCode.FINISHED
    if options.named_scenes and options.scenes:
        raise JobError("scenes are named twice", "--scenes", "Leave one of the two out.")
    experiment = Experiment(
        scenes=scenes_from(options.named_scenes or options.scenes or [SAMPLE], options.names),
        folder=options.output,
        rows=rows,
        only=tuple(options.only),
        preset=options.preset,
        steps=options.steps,
        sets=tuple(options.set or ()),
        scene_format=options.scene_format,
        mask_format=options.mask_format,
        classes=options.classes,
        seeds=tuple(options.seeds),
        earlier=read_results(options.against) if options.against else (),
        page=options.report,
        only_finished=options.finished,
    )
    try:
        with Interrupts() as interrupts:
            return run_experiment(experiment, interrupts)
    except Interrupted as error:
        print("Stopped. The same command goes on.", file=sys.stderr)
        return error.exit_code


def _listed(rows: Rows) -> list[str]:
    """A line a row, under the name of its table."""
    lines = []
    for table, heading in rows.tables.items():
        lines.append(f"{table}: {heading}")
        lines += [f"    {row.name}" for row in rows.rows if row.table == table and not row.is_cited]
    return lines
