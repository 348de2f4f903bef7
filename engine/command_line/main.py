"""The way from a command to its exit code."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial

from ..errors import PlgsError
from ..gates import printable
from ..job import ExitCode
from ..job.options import readable
from ..job.task import TaskPlace
from ..job.terminal import stdout_for_events
from .parser import make_parser
from .runner import Command, run_task

READER_GONE = 141
"""The shell's exit status of a command whose reader has ended, such as ``head``."""


def main(arguments: Sequence[str], parser: Callable[[], argparse.ArgumentParser] = make_parser) -> int:
    """Run a command and return its exit code. Bad arguments raise SystemExit(2), as usual with argparse."""
    _open_missing_streams()
    try:
        try:
            return _run(arguments, parser())
        finally:
            sys.stdout.flush()  # flushed here, where a closed reader is not yet an error
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes the rest when it exits
        return READER_GONE
    except OSError as error:
        what = f"this cannot be used ({error.strerror}): {error.filename or 'the disk'}"
        print(printable(f"error: {what}. Fix this, then try again."), file=sys.stderr)
        return ExitCode.BAD_INPUT
    except RuntimeError as error:  # so says Python before 3.13, where later ones go on
        if not str(error).startswith("Symlink loop"):
            raise
        print(printable(f"error: a link leads to itself: {error}. Mend or remove it."), file=sys.stderr)
        return ExitCode.BAD_INPUT


def _open_missing_streams() -> None:
    """Let standard streams that were closed lead nowhere. Otherwise the next files to be opened get their numbers, and
    what native code prints is written into them.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # the lowest number that is free
        os.set_inheritable(number, True)
    os.close(number)
    for name, mode, number in (("stdin", "r", 0), ("stdout", "w", 1), ("stderr", "w", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="replace", closefd=False))


def _run(arguments: Sequence[str], parser: argparse.ArgumentParser) -> int:
    options = parser.parse_args(readable(arguments))
    options.echo = stdout_for_events(vars(options).get("progress", "text"))
    try:
        code: int = _run_task(options) if vars(options).get("is_task") else options.run(options)
    except PlgsError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:  # in commands that leave nothing to continue
        print("Stopped.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return code


def _run_task(options: argparse.Namespace) -> int:
    place = None if options.events is None else TaskPlace.at(options.events)
    command = Command(options.command, partial(options.run, options), when_stopped=options.when_stopped)
    pipe = sys.stdin.fileno() if options.stay_with_parent else None
    return run_task(command, place, as_json=options.json, parent_pipe=pipe, echo=options.echo)
