"""What each command runs. Their modules load numpy and more, so each is imported when it is wanted: --help and a typing
error need none of it."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from ..job import ExitCode, JobError
from ..job.options import source_of
from ..job.stop import end_with_parent


def lift(options: argparse.Namespace) -> int:
    from . import lift

    return lift.lift_scene(options) if options.output else lift.run_folder(options)


def bake(options: argparse.Namespace) -> ExitCode:
    from . import lift

    return lift.bake_in_folder(options)


def export(options: argparse.Namespace) -> ExitCode:
    _stay_with_parent(options)
    from .export import export_lift

    return export_lift(options)


def evaluate(options: argparse.Namespace) -> ExitCode:
    from .evaluate import evaluate, evaluate_folders

    folders = [options.predictions, options.truth]
    if (options.lift is None) == (None in folders) or (options.lift is not None and any(folders)):
        raise JobError("give either LIFT, or --predictions and --truth", "evaluate", "--help tells more.")
    if options.lift is not None:
        return evaluate(options.lift, per_class=options.classes, as_json=options.json)
    return evaluate_folders(
        *folders, per_class=options.classes, ids_per_frame=options.ids_per_frame, as_json=options.json
    )


def presets(options: argparse.Namespace) -> ExitCode:
    from .presets import presets

    return presets(options.name, options.set, as_json=options.json)


def segment(options: argparse.Namespace) -> int:
    from .segment import segment

    return segment(options)


def experiments(options: argparse.Namespace) -> int:
    from .experiments import experiments

    return experiments(options)


def inspect(options: argparse.Namespace) -> ExitCode:
    _stay_with_parent(options)
    from .inspect_scene import inspect_scene

    return inspect_scene(
        source_of(options),
        as_json=options.json,
        preset=options.preset,
        findings=options.output,
        fix=options.fix,
    )


def frames(options: argparse.Namespace) -> ExitCode:
    _stay_with_parent(options)
    from .frames import write_frames

    return write_frames(options)


def handshake(options: argparse.Namespace) -> ExitCode:
    from .handshake import answer

    sys.stdout.buffer.write(answer().to_line())  # UTF-8 on every system, as a path may need
    return ExitCode.FINISHED


def warm_up(options: argparse.Namespace) -> ExitCode:
    from ..lift import warm_up

    warm_up()
    return ExitCode.FINISHED


def bench(options: argparse.Namespace) -> ExitCode:
    if options.json is not None:
        _refuse_unwritable(options.json)
    if options.what == "raster":
        from ..raster.bench import bench_raster

        bench_raster(options.json)
    elif options.what == "bake":
        from ..passes.bench import bench_bake

        bench_bake(options.json)
    elif options.what == "long":
        from ..lift.bench_long import bench_long

        bench_long(options.frames, options.output, options.preset, options.json)
    else:
        from ..lift.bench import bench_step

        bench_step(options.json)
    return ExitCode.FINISHED


def _stay_with_parent(options: argparse.Namespace) -> None:
    """Of the commands that may end at any time; the others have a ``Watchdog``."""
    if options.stay_with_parent:
        end_with_parent(sys.stdin.fileno())


def _refuse_unwritable(file: Path) -> None:
    """Before minutes of work: raise JobError when ``file`` could not be written."""
    if file.is_dir():
        raise JobError("the figures need a file, this is a folder", file, "Name a file in it.")
    if not file.parent.is_dir():
        raise JobError("there is no such folder to write the figures to", file.parent, "Make it, or name another file.")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise JobError("this cannot be written", file, "Name a file in a folder of yours.")
