"""``segment``: masks for a scene that has none."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from ..job import Cancelled, EventWriter, ExitCode, JobError, StopSignal, Watchdog
from ..job.follower import LiftStatus
from ..job.terminal import Interrupted, Interrupts, LiveLine
from ..scene import Scene, SceneError, open_scene
from ..segment import Job, Segmenter, begin_job, load_model, make_masks

EVENTS, CANCEL = "events.jsonl", "cancel"
"""In the folder of the masks: what an engine tells whoever watches, and the file that stops it."""
STAGE, LABEL = "segment", "Making masks"


def segment(options: argparse.Namespace) -> int:
    """Make the masks, or go on where they were left. Raises JobError, SceneError."""
    try:
        with Interrupts():
            return _segment(options)
    except Interrupted as error:
        print("Stopped. The same command goes on.", file=sys.stderr)
        return error.exit_code


def _segment(options: argparse.Namespace) -> ExitCode:
    place: Path = options.scene
    scene = open_scene(place, None, options.up or "z", options.scene_format)
    folder: Path = options.output or (place if place.is_dir() else place.with_suffix(""))
    name = str(Path(options.model).resolve()) if Path(options.model).is_dir() else options.model
    job = begin_job(folder, name, len(scene.frames))
    if job.is_finished:
        print(f"These masks are finished already: {folder}")
        return ExitCode.FINISHED
    try:
        network = load_model(name, download=options.download)
    except JobError:
        job.discard_if_empty()
        raise
    code = _make(scene, job, network, sys.stdin.fileno() if options.stay_with_parent else None)
    if code is ExitCode.FINISHED:
        print(f"Masks of {len(scene.frames)} frames: {folder}")
    return code


def _make(scene: Scene, job: Job, network: Segmenter, parent_pipe: int | None) -> ExitCode:
    """Make them, telling how far it is in events and on standard error."""
    events, stop, line = EventWriter(job.pictures / EVENTS), StopSignal(job.pictures / CANCEL), LiveLine(sys.stderr)
    began = time.monotonic()

    def progress(done: int, frames: int, made: int) -> None:
        eta = None if made == 0 else (time.monotonic() - began) / made * (frames - done)
        events.progress(STAGE, done, frames, eta_s=eta)
        line.show(LiftStatus(STAGE, LABEL, step=done, steps=frames, eta_s=eta))
        stop.check()

    try:
        (job.pictures / CANCEL).unlink(missing_ok=True)
        events.hello(threads=0, resumed=job.is_begun, task=STAGE)
        events.stage(STAGE, 1, 1, LABEL)
        with Watchdog(stop, events, parent_pipe=parent_pipe):
            make_masks(scene, job, network, progress)
        events.done("finished")
        return ExitCode.FINISHED
    except Cancelled as error:
        events.done("cancelled")
        line.say(f"Stopped: {error}. The same command goes on.")
        return stop.exit_code
    except (SceneError, JobError) as error:
        events.error(error.what, error.where, error.fix, ExitCode.BAD_INPUT)
        raise
    except OSError as error:
        fix = "Make room there, then go on."
        raise JobError(f"masks cannot be written ({error.strerror})", job.folder, fix) from error
    finally:
        line.end()
        events.close()
