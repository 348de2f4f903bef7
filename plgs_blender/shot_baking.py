"""Baking a camera of a .blend from a command line."""

from __future__ import annotations

import sys
from pathlib import Path

from ..engine.job import ExitCode, LiftFolder
from ..engine.job.follower import LiftFollower
from ..engine.job.process import engine_python
from ..engine.job.terminal import Interrupts, LiveLine, follow
from .lift_scene import open_blend
from .shots import shot_of, write_shot


def bake_shot_in_terminal(
    lift: LiftFolder,
    blend: Path,
    camera: str,
    frames: tuple[int | None, int | None, int | None],
    interrupts: Interrupts,
) -> ExitCode:
    """Bake what a camera of ``blend`` sees of a finished lift, over ``frames`` (first, last, step), the file's where
    None, showing it on stderr. The file is only read.

    Raises JobError; Interrupted on Ctrl-C, when the engine has ended.
    """
    python = engine_python()
    scene = open_blend(blend.absolute(), lift.path, named_by="--blend")
    cameras = write_shot(lift.path, scene, shot_of(scene, camera, *frames))
    with interrupts.deferred():
        follower = LiftFollower.start_bake(lift, python, cameras=cameras)
        outcome = follow(follower, interrupts, LiveLine(sys.stderr))
    if outcome.error is not None:
        print(f"error: {outcome.error}", file=sys.stderr)
    elif outcome.code is ExitCode.CANCELLED:
        print(f"Cancelled. Give the same command to go on: {lift.path}", file=sys.stderr)
    else:
        print(f"Baked: {lift.passes_path}", file=sys.stderr)
    return outcome.code
