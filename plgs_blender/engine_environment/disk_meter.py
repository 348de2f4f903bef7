"""How much lies in a folder, without ever waiting for a disk for long."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

BUDGET_S = 0.002
"""What a look takes: some folders of torch have thousands of files."""


class DiskMeter:
    """Adds up the files of a folder that grows, a bit at each look."""

    def __init__(self, folder: Path) -> None:
        self.bytes = 0
        """As the last whole walk, or the present one if it found more already, had it."""
        self._folder = folder
        self._sum = 0
        self._walk: Iterator[int] = iter(())

    def look(self) -> None:
        """Walk on for a few milliseconds."""
        give_up = time.perf_counter() + BUDGET_S
        while time.perf_counter() < give_up:
            size = next(self._walk, None)
            if size is None:
                self.bytes, self._sum = self._sum or self.bytes, 0
                self._walk = _sizes(self._folder)
                return
            self._sum += size
            self.bytes = max(self.bytes, self._sum)


def _sizes(folder: Path) -> Iterator[int]:
    """The bytes of one file after the other. What vanishes meanwhile, or cannot be looked at, counts nothing."""
    waiting = [str(folder)]
    while waiting:
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                else:
                    with suppress(OSError):
                        yield entry.stat(follow_symlinks=False).st_size
