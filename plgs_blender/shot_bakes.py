"""Bake a shot from a terminal, or write a job with which a render farm does so."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..engine.errors import ErrorCode, PlgsError
from ..engine.job import ExitCode, LiftFolder, write_atomically
from ..engine.job.follower import start_bake
from ..engine.job.process import engine_python
from ..engine.job.task import TaskProgress, TaskState
from ..engine.job.terminal import Interrupts, LiveLine, follow
from .engine_environment import studio
from .lift_scene import open_blend
from .shots import Shot, ShotReader, shot_of

JOB = "farm.json"
_SHOWN_EVERY_S = 1.0
"""Seconds between two lines that say how much of a camera's path is read."""
_CHUNK = 50  # frames per farm task
_PLATFORMS = {"win32": "windows", "darwin": "darwin"}


def bake_shot_in_terminal(
    lift: LiftFolder,
    blend: Path,
    camera: str,
    *,
    frames: Sequence[float],
    layers: Sequence[str],
    interrupts: Interrupts,
    echo: int | None = None,
    name: str = "",
    replace: bool = False,
    output: Path | None = None,
    channels: str = "",
) -> ExitCode:
    """Bake what a camera of ``blend`` sees of a finished lift over ``frames`` (none: the file's range), with these
    FURTHER_LAYERS, into the lift's result or the folder ``output``. ``channels`` is one of CHANNELS, and names the
    channels for another program. Progress goes to stderr and events to the descriptor ``echo``. ``name`` is the shot's;
    with ``replace``, it may be that of another file's, and other programs' files in ``output`` are overwritten. Raises
    PlgsError, and Interrupted after Ctrl-C, once the engine has ended."""
    python = engine_python()
    scene = open_blend(blend.absolute(), lift.path, named_by="--blend")
    shot = shot_of(scene, camera, given=name, only=frames, motion="vector" in layers)
    if shot.given and not name:
        print(f"From {studio().file}: names {shot.given}", file=sys.stderr)
    for what in shot.warnings:
        print(f"warning: {what}", file=sys.stderr)
    reader, line = ShotReader(scene, shot), LiveLine(sys.stderr)
    while not reader.read_for(_SHOWN_EVERY_S):
        step, steps = reader.progress
        line.show(TaskProgress("read", "Reading the camera", 1, 1, step, steps))
    line.end()
    try:
        cameras = reader.write(lift.path, replace=replace, output=output)
    except OSError as error:
        fix = "Name a folder that you can write to, on a disk with free space."
        raise PlgsError("unwritable", f"cannot be written to ({error.strerror})", output or lift.path, fix) from error
    for what in reader.said:
        print(f"warning: {what}", file=sys.stderr)
    with interrupts.deferred():
        while True:
            follower = start_bake(
                lift, python, cameras=cameras, layers=layers, output=output, channels=channels, replace=replace
            )
            follow(follower, interrupts, LiveLine(sys.stderr), echo)
            is_busy = follower.error is not None and follower.error.code is ErrorCode.BUSY
            if not is_busy or follower.files != lift.task_files or interrupts.pending is not None:
                break  # else another bake has the lift's own task files: bake with others
    reader.withdraw_unbaked(follower)
    if follower.error is not None:
        print(f"error: {follower.error}", file=sys.stderr)
    elif follower.state is TaskState.CANCELLED:
        print(f"Cancelled. Give the same command again to continue: {lift.path}", file=sys.stderr)
    else:
        print(f"Baked: {output or lift.passes_path}", file=sys.stderr)
    return follower.exit_code


def write_farm_job(scene: bpy.types.Scene, lift: LiftFolder, shot: Shot) -> Path:
    """Write the farm job that bakes a shot into a finished lift's folder, and return the file. The farm reads the
    camera from this .blend, as last saved. Raises OSError, and PlgsError if it was never saved."""
    blend = bpy.data.filepath
    if not blend:
        fix = "Save it where the farm can read it, then try again."
        raise PlgsError("unsaved", "the farm reads the camera from a file, and this one has no name", scene.name, fix)
    frames, is_range = shot.frames, shot.step == 1 and not shot.only
    settings = {
        "scene": str(lift.request.scene),
        "output": str(lift.path),
        "preset": lift.request.preset,
        "lift_options": "",
        "lifted": True,
        "bake": "camera",
        "blend": blend,
        "camera": "" if shot.cuts else shot.camera.name,
        "shot": shot.given,
        "frames": f"{frames[0]}-{frames[-1]}" if is_range else ",".join(f"{each:g}" for each in frames),
        "chunk_size": _CHUNK,
        "layers": " ".join(sorted(scene.plgs.layers)),
    }
    job = {
        "name": f"{lift.path.name}: {shot.camera.name}",
        "type": "plgs",
        "priority": 50,
        "submitter_platform": _PLATFORMS.get(sys.platform, "linux"),
        "settings": settings,
    }
    path = lift.path / "bake" / JOB
    path.parent.mkdir(exist_ok=True)
    write_atomically(path, json.dumps(job, indent=2) + "\n")
    return path
