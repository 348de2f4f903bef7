"""The end of a log, for a message to somebody who cannot be expected to open it."""

from __future__ import annotations

import os
from pathlib import Path

from ..gates import open_plain

MOST_BYTES = 1 << 16
LONGEST_LINE = 500


def last_lines(log: Path, count: int = 20) -> tuple[str, ...]:
    """The last ``count`` lines that say something, of the log's last 64 KB; none where there is no log.

    Lines are cut at 500 characters; of one that was written over and over (a progress bar's) each version counts.
    """
    try:
        with open_plain(log, follow_link=False) as file:
            start = max(0, os.fstat(file.fileno()).st_size - MOST_BYTES)
            file.seek(start)
            content = file.read(MOST_BYTES)
    except OSError:  # never begun, or deleted: then it says nothing
        return ()
    lines = content.decode("utf-8", errors="replace").splitlines()
    told = [line.rstrip()[:LONGEST_LINE] for line in lines[1 if start else 0 :] if line.strip()]
    return tuple(told[-count:])
