"""The way from a command to its exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from ..gates import printable
from ..job import ExitCode, JobError
from ..job.options import readable
from . import commands
from .parser import make_parser

READER_GONE = 141
"""The shell's number of a command whose reader wants no more of it, such as ``head``."""


def main(arguments: Sequence[str]) -> int:
    """Run a command and return its exit code. Bad arguments end with SystemExit(2), as argparse has it."""
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()  # here, where a reader that is gone is no error yet
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes what is left at its end
        return READER_GONE
    except OSError as error:
        what = f"this cannot be used ({error.strerror}): {error.filename or 'the disk'}"
        print(printable(f"error: {what}. See to it, then try again."), file=sys.stderr)
        return ExitCode.BAD_INPUT


def _run(arguments: Sequence[str]) -> int:
    options = make_parser().parse_args(readable(arguments))
    # The handshake tells of numpy when it is missing, and --help does not wait for it.
    errors: tuple[type[Exception], ...] = (JobError,)
    if options.run is not commands.handshake:
        from ..scene import SceneError

        errors = (JobError, SceneError)
    try:
        code: int = options.run(options)
    except errors as error:
        print(f"error: {error}", file=sys.stderr)
        return ExitCode.BAD_INPUT
    except KeyboardInterrupt:  # of commands that have nothing to go on with
        print("Stopped.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return code
