"""``frames``: a scene's pictures, depth and masks as files that any program opens, and a coloured cloud."""

from __future__ import annotations

import argparse
import sys

from ..frames import make_frames
from ..job import ExitCode, JobError
from ..job.options import source_of
from ..scene import open_asked


def write_frames(options: argparse.Namespace) -> ExitCode:
    """Write them, a line for each frame that is done. Raises JobError, SceneError."""
    source = source_of(options)
    scene = open_asked(source)
    try:
        made = make_frames(scene, source.resolved, options.output.resolve(), options.make, options.frames, _tell)
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
