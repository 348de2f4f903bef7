"""Run experiments: each row of the tables on each scene, each lift in its own process, one after the other."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from engine.batch.plan import refuse_shared
from engine.errors import Cancelled, PlgsError
from engine.job import ExitCode, LiftFolder, refuse_used
from engine.job.request import request_from
from engine.job.terminal import Interrupts, lift_in_terminal
from engine.posed.layout import listed
from engine.scene import open_scene_to_lift

from ..baselines.without_a_lift import scores_without_a_lift
from ..results import Result, read_result, this_engine
from .experiment import Experiment, Task, has_files, has_manifest, tasks_of
from .report import write_report


def run_experiment(experiment: Experiment, interrupts: Interrupts) -> ExitCode:
    """Lift what has not been lifted yet, print the tables of the chosen rows, and write a report of what is finished of
    these scenes to the folder, which is updated after each lift. A lift that fails becomes a row with its reason, and
    the others are still tried; returns the first failure's exit code. Raises PlgsError before any lift for errors that
    concern all; Interrupted on Ctrl-C: the same call continues."""
    tasks = list(tasks_of(experiment))
    if experiment.only_finished:
        tasks = [task for task in tasks if has_manifest(task.options.output)]
    errors = refuse_bad_input(experiment, tasks)
    whole = replace(experiment, only=())  # finished lifts of other rows stay in the report
    others = [task for task in tasks_of(whole) if task.name not in {one.name for one in tasks}]
    results = [*results_without_a_lift(experiment, errors), *results_before(experiment, others)]
    for number, task in enumerate(tasks, start=1):
        print(f"{task.name}, {experiment.preset_name} ({number} of {len(tasks)})", file=sys.stderr)
        try:
            if task.name in errors:
                raise errors[task.name]
            results.append(lifted(experiment, task, interrupts))
            if (code := results[-1].engine_version) != this_engine():
                fix = f"To lift it again, delete {task.options.output}"
                print(f"{task.name}: lifted by {code}, not by this {this_engine()}. {fix}", file=sys.stderr)
        except PlgsError as error:
            errors[task.name] = error
            print(f"{task.name}: failed: {error}", file=sys.stderr)
            about = task.scene.name, task.row.name, experiment.preset_name, 0, task.seed, this_engine()
            results.append(Result(*about, failed=str(error)))
        except Cancelled:
            return ExitCode.CANCELLED
        write_report(experiment.folder, whole.tables(tuple(results)))
    if results:
        write_report(experiment.folder, whole.tables(tuple(results)))
        print(experiment.tables(tuple(results)).markdown(), end="")
    if errors:
        print(f"Failed: {listed(list(errors))}. The same command tries again.", file=sys.stderr)
    return next((error.exit_code for error in errors.values()), ExitCode.FINISHED)


def lifted(experiment: Experiment, task: Task, interrupts: Interrupts) -> Result:
    """Return the figures of a task, which is lifted first if it is not finished. Raises PlgsError if that fails;
    Cancelled, Interrupted."""
    if experiment.only_finished:
        return result_of(experiment, task)
    if task.depth_of is not None:
        make_depth_maps(task.depth_of, task.options.depth)
    errors: list[PlgsError] = []
    lift, code = lift_in_terminal(task.options, interrupts, errors.append)
    if code is ExitCode.CANCELLED:
        raise Cancelled
    if errors:
        raise errors[0]
    return read_result(task.scene.name, task.row.name, experiment.preset_name, lift)


def result_of(experiment: Experiment, task: Task) -> Result:
    """Return the figures of a finished lift. Raises PlgsError if they cannot be read."""
    lift = LiftFolder.open(task.options.output)
    return read_result(task.scene.name, task.row.name, experiment.preset_name, lift)


def results_before(experiment: Experiment, others: list[Task]) -> Iterator[Result]:
    """Yield the figures of those tasks that are finished already. Unreadable ones are left out, with a warning."""
    for task in others:
        try:
            if is_finished(task):
                yield result_of(experiment, task)
        except PlgsError as error:
            print(f"Not in the report: {task.name}: {error}", file=sys.stderr)


def is_finished(task: Task) -> bool:
    """Whether a task's lift, with exactly these options, is finished. Raises PlgsError if its folder is unreadable."""
    if not has_manifest(task.options.output):
        return False
    return not request_from(task.options).differences(LiftFolder.open(task.options.output).request)


def make_depth_maps(lift: Path, maps: Path) -> None:
    """Write the rendered depth of all frames of a lift into the folder ``maps``, unless that exists. Raises PlgsError
    if the lift is not finished."""
    if not has_manifest(lift):
        what = "the lift whose depth is needed is not finished"
        raise PlgsError("not-finished", what, lift, "Find out why that lift failed.")
    if not (maps / "complete").is_file():
        from engine.export.run import export

        export(LiftFolder.open(lift), "depth", maps, ["all"])
        (maps / "complete").touch()  # last, so that a stopped export is made again


def results_without_a_lift(experiment: Experiment, errors: dict[str, PlgsError]) -> Iterator[Result]:
    """Yield results that need no lift, if rows ask for them. If a scene fails, its rows get the error as their reason,
    and the error is added to ``errors``."""
    wanted = experiment.rows.chosen(experiment.only)
    for scene in experiment.scenes:
        rows = [row for row in wanted if row.method and has_files(row, scene)]
        for masks in dict.fromkeys(row.masks for row in rows):
            asking = [row for row in rows if row.masks == masks]
            try:
                found = scores_without_a_lift(experiment.source(scene, masks))
            except PlgsError as error:
                for row in asking:
                    errors[f"{scene.name}: {row.name}"] = error
                    yield Result(scene.name, row.measured_as, "-", 0, 0, this_engine(), failed=str(error))
                continue
            for method, figures in found.items():
                name = f"{method}, {masks}" if masks else method
                yield Result(scene.name, name, "-", 0, 0, this_engine(), figures)


def refuse_bad_input(experiment: Experiment, tasks: Sequence[Task]) -> dict[str, PlgsError]:
    """Raise PlgsError, before hours of work, for the first thing that is wrong for all tasks, and return the errors of
    single scenes by task name."""
    errors: dict[str, PlgsError] = {}
    for option, path in (("--masks", experiment.masks), ("--depth", experiment.depth)):
        refuse_shared(option, path, len(experiment.scenes))
    for task in tasks:
        request = request_from(task.options)
        output = task.options.output
        if not (output / "request.json").exists():
            refuse_used(output)
            try:
                open_scene_to_lift(replace(request, depth=None) if task.depth_of else request)
            except PlgsError as error:
                errors[task.name] = error
            continue
        lift = LiftFolder.open(output)
        differing = request.differences(lift.request)  # unlike lift --resume: an option left out asks for the default
        if differing:
            fix = "Give the same options again, or choose another folder with -o."
            raise PlgsError("other-options", f"holds a lift with a different {', '.join(differing)}", lift.path, fix)
    try:
        experiment.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fix = "Choose a folder that you may write to."
        raise PlgsError("unwritable", f"cannot be created ({error.strerror})", experiment.folder, fix) from error
    if not os.access(experiment.folder, os.W_OK):
        what = "cannot be written"
        raise PlgsError("unwritable", what, experiment.folder, "Choose a folder that you may write to with -o.")
    return errors
