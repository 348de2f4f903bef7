"""Everything a process says, native libraries included, into one file."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


@contextmanager
def output_to(log: Path) -> Iterator[TextIO]:
    """Append standard output and error of the whole process to ``log`` meanwhile; yields the real standard error.

    File descriptors are moved, not Python's objects: so what C++ prints lands there too, and a crash's last words.
    """
    _flush()
    out, err = os.dup(1), os.dup(2)
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    try:
        with os.fdopen(os.dup(err), "w", encoding="utf-8", errors="replace", buffering=1) as terminal:
            yield terminal
    finally:
        _flush()
        for saved, number in ((out, 1), (err, 2)):
            os.dup2(saved, number)
            os.close(saved)


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
