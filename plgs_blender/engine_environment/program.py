"""Run another program as a part of a state machine: its output goes to a log that is read as it grows."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path

from ...engine.gates import without_credentials
from ...engine.job import JobError
from ...engine.job.process import ChildProcess

_MOST_BYTES = 200_000
"""Bytes of the log that one poll reads."""


def run_program(
    command: Sequence[str | Path],
    log_path: Path,
    environment: Mapping[str, str],
    *,
    cwd: Path,
    read_line: Callable[[str], object] = lambda line: None,
    keep_open: Sequence[int] = (),
    limit_s: float | None = None,
) -> Generator[None, None, tuple[str, int]]:
    """One ``yield`` a poll; returns what the program said and its exit code. When the generator is closed, the program
    ends with its children.

    Raises JobError when it cannot be started, or when ``limit_s`` is over.
    """
    yield  # starting a program takes milliseconds: a poll of its own
    began = time.monotonic()
    with log_path.open("ab") as log, log_path.open("rb") as reader:
        log.write(without_credentials(f"\n$ {' '.join(map(str, command))}\n").encode())
        log.flush()
        reader.seek(log.tell())
        process = ChildProcess(command, cwd=cwd, environment=environment, output=log, keep_open=keep_open)
        output = line = ""
        try:
            while True:
                code = process.exit_code()  # before the look at its output, so that the last lines are in it
                new = reader.read(_MOST_BYTES).decode(errors="replace")
                output = (output + new)[-_MOST_BYTES:]
                *whole, line = (line + new).split("\n")
                for each in whole:
                    read_line(each)
                if code is not None and not new:
                    return output, code
                if limit_s is not None and time.monotonic() - began > limit_s:
                    raise JobError("does not answer", command[0], "Choose another one.")
                yield
        finally:
            process.kill()
