"""The size of the memory kept for reuse."""

from __future__ import annotations

from engine.machine import memory


def held_bytes() -> int:
    """All of it, in use or not."""
    with memory._lock:  # other threads make and drop blocks
        return sum(block.bytes.size for block in memory._blocks)
