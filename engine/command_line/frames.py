"""``frames``: a scene's pictures, depth and masks as files that any program opens, and a coloured cloud."""

from __future__ import annotations

import argparse
import sys

from ..frames import make_frames
from ..job import ExitCode, JobError
from ..job.made_frames import SceneSource
from ..scene import open_scene


def write_frames(options: argparse.Namespace) -> ExitCode:
    """Write them, a line for each frame that is done. Raises JobError, SceneError."""
    scene = open_scene(
        options.scene, options.masks, options.up or "z", options.scene_format, options.depth,
        options.mask_format, options.classes,
    )  # fmt: skip
    masks, depth = (None if path is None else path.resolve() for path in (options.masks, options.depth))
    source = SceneSource(
        options.scene.resolve(), masks, options.up or "z", options.scene_format, depth,
        options.mask_format, options.classes,
    )  # fmt: skip
    try:
        made = make_frames(scene, source, options.output.resolve(), options.make, options.frames, _tell)
    except KeyboardInterrupt:
        print("Stopped. What is made already is kept: the same command goes on.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except OSError as error:
        fix = "Name a folder that you may write to, on a disk with space."
        raise JobError(f"cannot be written ({error.strerror})", error.filename or options.output, fix) from error
    print(f"{len(made.frames)} frames in {made.folder}")
    return ExitCode.FINISHED


def _tell(done: int, total: int) -> None:
    print(f"frames {done}/{total}", flush=True)
