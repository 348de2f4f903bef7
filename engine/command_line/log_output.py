"""Redirection of all output of a process, including native libraries, into one file."""

from __future__ import annotations

import faulthandler
import io
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

from ..gates import open_to_append


@contextmanager
def output_to(log: Path) -> Iterator[TextIO]:
    """Append all output to ``log`` in this context. Yields the real standard error, for the few lines for the user.

    Python's streams and logging go there, and the file descriptors below them, so that the output of C++ and the Python
    traceback of a crash in it get there too.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    out, err = os.dup(1), os.dup(2)
    with (
        _open_log(log) as file,
        os.fdopen(os.dup(2), "w", encoding="utf-8", errors="replace", buffering=1) as terminal,
    ):
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            with redirect_stdout(file), redirect_stderr(file), _logging_to(file):
                yield terminal
        finally:
            for saved, number in ((out, 1), (err, 2)):
                os.dup2(saved, number)
                os.close(saved)


class _BestEffortFile(io.FileIO):
    """Output that does not fit on a full disk is lost: a log must neither make a lift fail nor hide its error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError:
            return memoryview(data).nbytes


def _open_log(log: Path) -> TextIO:
    raw = io.BufferedWriter(_BestEffortFile(open_to_append(log), "ab"))
    return io.TextIOWrapper(raw, encoding="utf-8", errors="replace", line_buffering=True)


@contextmanager
def _logging_to(file: TextIO) -> Iterator[None]:
    handler = logging.StreamHandler(file)
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    root = logging.getLogger()
    level, were_faults_told = root.level, faulthandler.is_enabled()
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    faulthandler.enable(file=file)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(level)
        if were_faults_told:
            faulthandler.enable(file=sys.__stderr__ or 2)
        else:
            faulthandler.disable()
