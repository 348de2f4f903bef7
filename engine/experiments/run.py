"""One experiment: every scene lifted in a process of its own, then one table of all figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..job import ExitCode, JobError, LiftFolder, LiftRequest, refuse_used, write_atomically
from ..job.options import request_from
from ..job.session import lift_in_terminal
from ..job.terminal import Interrupts
from ..scene import open_scene
from .figures import SceneResult, read_result
from .results import results_text
from .scenes import SceneToLift
from .table import markdown_table

_NO_MATCH = "Compare with results of these scenes and this preset."


@dataclass(frozen=True)
class Experiment:
    """Lifts of ``scenes`` into ``folder``, all with the same settings. ``earlier``: results to compare with."""

    scenes: tuple[SceneToLift, ...]
    folder: Path
    preset: str = "preview"
    steps: int | None = None
    seed: int = 0
    earlier: tuple[SceneResult, ...] = ()


def run_experiment(experiment: Experiment, interrupts: Interrupts) -> ExitCode:
    """Lift what is not lifted yet, print the table, and write results.json and results.md; both grow lift by lift.

    A lift that fails does not keep the others from being tried; the first one's exit code is returned. Raises JobError
    and SceneError before any lift begins, Interrupted on Ctrl-C; the same call goes on then.
    """
    asked = [lift_options(experiment, scene) for scene in experiment.scenes]
    refuse_bad_input(experiment, asked)
    results: list[SceneResult] = []
    failed: dict[str, ExitCode] = {}
    for number, (scene, options) in enumerate(zip(experiment.scenes, asked, strict=True), start=1):
        print(f"{scene.name}, {experiment.preset} ({number} of {len(asked)})", file=sys.stderr)
        lift, code = lift_in_terminal(options, interrupts, check_scene_folder)
        if code is ExitCode.CANCELLED:
            return code
        if code is not ExitCode.FINISHED:
            failed[scene.name] = code
            continue
        results.append(read_result(scene.name, lift))
        write_results(experiment, results)
    if results:
        print(markdown_table(results, experiment.earlier), end="")
    if failed:
        print(f"Not lifted: {', '.join(failed)}. The same command tries again.", file=sys.stderr)
    return next(iter(failed.values()), ExitCode.FINISHED)


def lift_options(experiment: Experiment, scene: SceneToLift) -> argparse.Namespace:
    """What ``lift SCENE -o FOLDER/NAME-PRESET --bake none --resume`` would have been given."""
    return argparse.Namespace(
        scene=scene.folder,
        output=experiment.folder / f"{scene.name}-{experiment.preset}",
        preset=experiment.preset,
        steps=experiment.steps,
        size=None,
        frames=None,
        fit=None,
        seed=experiment.seed,
        masks=None,
        up=scene.up,
        scene_format=None,
        mask_format=None,
        classes=None,
        depth=None,
        device=None,
        names_from=None,
        bake="none",
        resume=True,
    )


def refuse_bad_input(experiment: Experiment, asked: Sequence[argparse.Namespace]) -> None:
    """Before hours of work: raise JobError or SceneError for the first thing that is wrong."""
    if experiment.earlier:
        known = {(result.scene, result.preset) for result in experiment.earlier}
        if not known & {(scene.name, experiment.preset) for scene in experiment.scenes}:
            held = ", ".join(f"{scene} {preset}" for scene, preset in sorted(known))
            raise JobError("the earlier results have none of these scenes", held, _NO_MATCH)
    for options in asked:
        request = request_from(options)
        if not (options.output / "request.json").exists():
            refuse_used(options.output)
            check_scene_folder(request)
            continue
        lift = LiftFolder.open(options.output)
        differing = request.differences(lift.request)  # unlike lift --resume: an option left out asks for the default
        if differing:
            fix = "Give the same options again, or choose another folder with -o."
            raise JobError(f"holds a lift with another {', '.join(differing)}", lift.path, fix)
    try:
        experiment.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fix = "Choose a folder that you may write to."
        raise JobError(f"cannot be made ({error.strerror})", experiment.folder, fix) from error


def check_scene_folder(request: LiftRequest) -> None:
    """Raises SceneError when the scene cannot be opened."""
    open_scene(request.scene, request.masks, request.up)


def write_results(experiment: Experiment, results: Sequence[SceneResult]) -> None:
    """results.json and results.md. Raises JobError when they cannot be written."""
    try:
        write_atomically(experiment.folder / "results.json", results_text(results))
        write_atomically(experiment.folder / "results.md", markdown_table(results, experiment.earlier))
    except OSError as error:
        fix = "Make room there, or choose a folder that you may write to with -o."
        raise JobError(f"the results cannot be written ({error.strerror})", experiment.folder, fix) from error
