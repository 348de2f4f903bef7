"""Experiments: each row of the tables on each scene, a lift in a process of its own, one after the other."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from engine import __version__
from engine.errors import PlgsError
from engine.job import ExitCode, LiftFolder, refuse_used
from engine.job.options import request_from
from engine.job.session import lift_in_terminal
from engine.job.terminal import Interrupts
from engine.presets.options import shown_options
from engine.scene import open_scene_to_lift
from engine.scene_source import SceneSource

from ..baselines.without_a_lift import scores_without_a_lift
from ..results import Result, read_result
from .report import refuse_unwritable, write_report
from .rows import Row, Rows
from .scenes import SceneToLift
from .table import Tables

_NO_MATCH = "Compare with results of these scenes, rows and this preset."
PROGRAM = "research"
"""It knows the options of the baselines."""
FIRST = "ours"
"""The row whose lift is the preset itself: its folder has no name of a row."""


@dataclass(frozen=True)
class Experiment:
    """Rows of the tables (``only`` some: of these names or tables) on ``scenes``, into ``folder``. All start from
    ``preset`` (a name, or a file) with ``steps`` and the options ``sets`` (name=value); all scenes are read by
    ``scene_format``, ``mask_format`` and ``classes``, as a LiftRequest has them. ``earlier``: results to compare with;
    ``page``: a Markdown file whose tables are brought up to date; ``only_finished``: nothing more is lifted."""

    scenes: tuple[SceneToLift, ...]
    folder: Path
    rows: Rows
    only: tuple[str, ...] = ()
    preset: str = "preview"
    steps: int | None = None
    sets: tuple[str, ...] = ()
    scene_format: str | None = None
    mask_format: str | None = None
    classes: str | None = None
    seeds: tuple[int, ...] = (0,)
    earlier: tuple[Result, ...] = ()
    page: Path | None = None
    only_finished: bool = False

    @property
    def preset_name(self) -> str:
        return Path(self.preset).stem

    def tables(self, results: tuple[Result, ...] = ()) -> Tables:
        return Tables(self.rows, self.rows.chosen(self.only), results, self.earlier)


@dataclass(frozen=True)
class Task:
    """One row on one scene with one seed; ``options``: what the command ``lift`` would have been given; ``depth_of``:
    the folder of the lift whose rendered depth it takes."""

    scene: SceneToLift
    row: Row
    seed: int
    options: argparse.Namespace
    depth_of: Path | None = None

    @property
    def name(self) -> str:
        seed = f", seed {self.seed}" if self.seed else ""
        return f"{self.scene.name}: {self.row.name}{seed}"


def run_experiment(experiment: Experiment, interrupts: Interrupts) -> ExitCode:
    """Lift what is not lifted yet, print the tables of the chosen rows, and write the report of all that is finished in
    the folder, which grows lift by lift.

    A lift that fails does not keep the others from being tried; the first one's exit code is returned. Raises PlgsError
    before any lift begins, Interrupted on Ctrl-C; the same call goes on then.
    """
    tasks = list(tasks_of(experiment))
    if experiment.only_finished:
        tasks = [task for task in tasks if has_manifest(task.options.output)]
    refuse_bad_input(experiment, tasks)
    whole = replace(experiment, only=())  # what is finished of other rows stays in the report
    others = [task for task in tasks_of(whole) if task.name not in {one.name for one in tasks}]
    finished_before = dict(results_before(experiment, others))
    results = [*results_without_a_lift(experiment), *finished_before.values()]
    failed: dict[str, ExitCode] = {}
    for number, task in enumerate(tasks, start=1):
        if experiment.only_finished:
            results.append(result_of(experiment, task))
            continue
        print(f"{task.name}, {experiment.preset_name} ({number} of {len(tasks)})", file=sys.stderr)
        if task.depth_of is not None and not make_depth_maps(task.depth_of, task.options.depth):
            failed[task.name] = ExitCode.BAD_INPUT
            continue
        _, code = lift_in_terminal(task.options, interrupts, open_scene_to_lift)
        if code is ExitCode.CANCELLED:
            return code
        if code is not ExitCode.FINISHED:
            failed[task.name] = code
            continue
        results.append(result_of(experiment, task))
        write_report(experiment.folder, whole.tables(tuple(results)))
    if results:
        shown = [task for task in others if task.name in finished_before]
        shown += [task for task in tasks if task.name not in failed]
        sheets = {task.name: task.options.output for task in shown}
        write_report(experiment.folder, whole.tables(tuple(results)), sheets=sheets, page=experiment.page)
        print(experiment.tables(tuple(results)).markdown(), end="")
    if failed:
        print(f"Not lifted: {'; '.join(failed)}. The same command tries again.", file=sys.stderr)
    return next(iter(failed.values()), ExitCode.FINISHED)


def result_of(experiment: Experiment, task: Task) -> Result:
    """The figures of a finished lift. Raises PlgsError when they cannot be read."""
    lift = LiftFolder.open(task.options.output)
    return read_result(task.scene.name, task.row.name, experiment.preset_name, lift)


def results_before(experiment: Experiment, others: list[Task]) -> Iterator[tuple[str, Result]]:
    """Name and figures of those lifts that are finished already. One that cannot be read is left out with a line."""
    for task in others:
        try:
            if is_finished(task):
                yield task.name, result_of(experiment, task)
        except PlgsError as error:
            print(f"Not in the report: {task.name}: {error}", file=sys.stderr)


def has_manifest(lift: Path) -> bool:
    return (lift / "result" / "manifest.json").is_file()


def is_finished(task: Task) -> bool:
    """Whether its lift, by these very options, is finished already. Raises PlgsError when its folder cannot be read."""
    if not has_manifest(task.options.output):
        return False
    return not request_from(task.options).differences(LiftFolder.open(task.options.output).request)


def tasks_of(experiment: Experiment) -> Iterator[Task]:
    """The lifts that the chosen rows need, row by row; those whose scene lacks the row's files are left out."""
    wanted = [experiment.rows.lift_of(row) for row in experiment.rows.chosen(experiment.only)]
    wanted += [experiment.rows.named(row.depth_from) for row in wanted if row.depth_from]
    for row in dict.fromkeys(row.name for row in experiment.rows.rows if row in wanted and row.is_lift):
        for scene in experiment.scenes:
            for seed in experiment.seeds:
                own = experiment.rows.named(row)
                if has_files(own, scene):
                    source = experiment.rows.named(own.depth_from) if own.depth_from else None
                    depth_of = None if source is None else lift_folder(experiment, scene, source, seed)
                    yield Task(scene, own, seed, lift_options(experiment, scene, own, seed), depth_of)


def make_depth_maps(lift: Path, maps: Path) -> bool:
    """The rendered depth of all frames of a lift, written once; False where the lift did not finish."""
    if not has_manifest(lift):
        return False
    if not (maps / "complete").is_file():
        from engine.export.run import export

        export(LiftFolder.open(lift), "depth", maps, ["all"])
        (maps / "complete").touch()
    return True


def has_files(row: Row, scene: SceneToLift) -> bool:
    """Whether a scene has the files that a row takes in place of the usual ones."""
    return row.masks is None or (scene.folder / row.masks).exists()


def lift_folder(experiment: Experiment, scene: SceneToLift, row: Row, seed: int) -> Path:
    """Where a row is lifted into."""
    parts = [scene.name, experiment.preset_name, "" if row.name == FIRST else row.slug, f"seed{seed}" if seed else ""]
    return experiment.folder / "-".join(part for part in parts if part)


def lift_options(experiment: Experiment, scene: SceneToLift, row: Row, seed: int) -> argparse.Namespace:
    """What ``lift SCENE -o FOLDER/SCENE-PRESET-ROW --bake none --resume`` would have been given."""
    output = lift_folder(experiment, scene, row, seed)
    return argparse.Namespace(
        program=PROGRAM,
        scene=scene.folder,
        output=output,
        preset=experiment.preset,
        set=[*experiment.sets, *shown_options(row.options)],  # the later one holds: a row is what its name says
        steps=experiment.steps,
        size=None,
        frames=None,
        fit=None,
        seed=seed,
        masks=scene.folder / row.masks if row.masks else None,
        up=scene.up,
        scene_format=experiment.scene_format,
        mask_format=experiment.mask_format,
        classes=experiment.classes,
        depth=output.with_name(f"{output.name}-maps") if row.depth_from else None,
        device=None,
        names_from=None,
        poses=None,
        blocks=None,
        block=None,
        bake="none",
        resume=True,
    )


def results_without_a_lift(experiment: Experiment) -> Iterator[Result]:
    """What needs no lift, where rows ask for it or it was measured before. Raises PlgsError when a file is bad."""
    wanted = experiment.rows.chosen(experiment.only)
    for scene in experiment.scenes:
        rows = [row for row in experiment.rows.rows if row.method and has_files(row, scene)]
        for masks in dict.fromkeys(row.masks for row in rows):
            source = SceneSource(
                scene.folder, scene.folder / masks if masks else None, scene.up, experiment.scene_format,
                mask_format=experiment.mask_format, classes=experiment.classes,
            )  # fmt: skip
            cache = experiment.folder / f"{scene.name}-{Path(masks or 'own').stem}-masks.json"
            if not cache.is_file() and not any(row.masks == masks and row in wanted for row in rows):
                continue
            for method, figures in scores_without_a_lift(source, cache).items():
                name = f"{method}, {masks}" if masks else method
                yield Result(scene.name, name, "-", 0, 0, __version__, figures)


def refuse_bad_input(experiment: Experiment, tasks: list[Task]) -> None:
    """Before hours of work: raise PlgsError for the first thing that is wrong."""
    if experiment.page:
        refuse_unwritable(experiment.page)
    if experiment.earlier:
        known = {result.key[:2] for result in experiment.earlier}
        if not known & {(task.scene.name, task.row.name) for task in tasks}:
            held = ", ".join(f"{scene} {row}" for scene, row in sorted(known)[:9])
            raise PlgsError("the earlier results have none of these scenes and rows", held, _NO_MATCH)
    for task in tasks:
        request = request_from(task.options)
        output = task.options.output
        if not (output / "request.json").exists():
            refuse_used(output)
            open_scene_to_lift(replace(request, depth=None) if task.depth_of else request)
            continue
        lift = LiftFolder.open(output)
        differing = request.differences(lift.request)  # unlike lift --resume: an option left out asks for the default
        if differing:
            fix = "Give the same options again, or choose another folder with -o."
            raise PlgsError(f"holds a lift with another {', '.join(differing)}", lift.path, fix)
    try:
        experiment.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fix = "Choose a folder that you may write to."
        raise PlgsError(f"cannot be made ({error.strerror})", experiment.folder, fix) from error
    if not os.access(experiment.folder, os.W_OK):
        raise PlgsError("cannot be written", experiment.folder, "Choose a folder that you may write to with -o.")
