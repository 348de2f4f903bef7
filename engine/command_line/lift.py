"""``lift``: in a folder that is there, or from a scene. ``bake``: more views of a finished lift."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..job import ExitCode, JobError, LiftFolder, read_cameras
from ..job.options import given_lift_options
from ..job.report import made_files, metrics_table
from ..job.session import lift_in_terminal
from ..job.terminal import Interrupted, Interrupts
from ..scene import open_scene_to_lift
from .run_engine import run_bake, run_engine


def run_folder(options: argparse.Namespace) -> ExitCode:
    """``lift LIFT``: this process is the engine. Raises JobError."""
    given = given_lift_options(options)
    if given:
        fix = "Leave them out, or lift a scene into a new folder with -o."
        raise JobError("a lift's request never changes", ", ".join(given), fix)
    folder = LiftFolder.open(options.scene)
    return run_engine(folder, resume=options.resume, parent_pipe=_parent_pipe(options, folder))


def bake_in_folder(options: argparse.Namespace) -> ExitCode:
    """``bake LIFT``: this process is the engine. Raises JobError."""
    folder = LiftFolder.open(options.lift)
    frames = options.frames if options.frames or options.cameras else ["all"]
    if options.cameras is not None:
        refuse_no_file_of_cameras(options.cameras)
        read_cameras(options.cameras)  # what is wrong is told at once, not after the model was read
    pipe = _parent_pipe(options, folder)
    return run_bake(folder, frames, cameras=options.cameras, parent_pipe=pipe, events_path=options.events)


def refuse_no_file_of_cameras(path: Path) -> None:
    """Raises JobError: perhaps a camera of a .blend is meant, whose name "--camera NAME" gives to "--cameras"."""
    if not path.is_file():
        fix = "--help tells what such a file holds; cameras of a .blend are baked by run_plgs.py --bake camera."
        raise JobError("there is no such file of cameras", path, fix)


def _parent_pipe(options: argparse.Namespace, folder: LiftFolder) -> int | None:
    if options.stay_with_parent:
        return sys.stdin.fileno()
    print(f"The engine's output goes to {folder.log_path}", flush=True)
    return None


def lift_scene(options: argparse.Namespace) -> int:
    """``lift SCENE -o OUT``: a second process is the engine, this one shows it. Raises JobError, SceneError."""
    try:
        with Interrupts() as interrupts:
            lift, code = lift_in_terminal(options, interrupts, open_scene_to_lift)
    except Interrupted as error:
        print(f"Stopped. Give the same command with --resume to go on: {options.output}", file=sys.stderr)
        return error.exit_code
    if code is ExitCode.FINISHED:
        print(metrics_table(lift), "", *made_files(lift), sep="\n")
    return code
