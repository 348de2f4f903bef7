"""How much this process has read from files: tells a quick look from reading all, whatever else the machine does."""

from __future__ import annotations

from pathlib import Path

import pytest

COUNTERS = Path("/proc/self/io")


def bytes_read() -> int:
    """Bytes that this process has read so far, as Linux counts them. Skips the test where nobody counts."""
    if not COUNTERS.exists():
        pytest.skip("needs Linux's count of bytes read")
    counts = dict(line.split(": ") for line in COUNTERS.read_text().splitlines())
    return int(counts["rchar"])
