"""How many things a file claims to hold: checked against its size and the free memory before they are read.

Every reader of a scene asks here with what it knows: a count in a header, the bytes left, the memory that one takes.
"""

from __future__ import annotations

from pathlib import Path

from ..errors import PlgsError
from ..job.system import main_memory

_SHARE_OF_MEMORY = 0.5
"""The share of the free memory that one file may take: the rest of the scene needs some as well."""

_SMALL = 1 << 25
"""Bytes up to which the free memory is not asked for."""


def check_count(count: int, things: str, path: Path, fix: str, *, most: int, room: int, made: int) -> None:
    """Raise PlgsError for a ``count`` of ``things`` in the file ``path`` that cannot be true, or cannot be read here.

    ``room`` is the most that the bytes left in the file can hold; ``most`` how many are read within ten seconds;
    ``made`` how many bytes of memory one of them takes.
    """
    if count > room:
        raise PlgsError("the file is cut off", path, fix)
    check_most(count, things, path, fix, most)
    check_memory(count * made, path)


def check_most(count: int, things: str, path: Path | str, fix: str, most: int) -> None:
    """Raise PlgsError for more than ``most`` things, counted as they are found."""
    if count > most:
        raise PlgsError(f"the file has more than {most} {things}", path, fix)


def check_memory(size: int, path: Path) -> None:
    """Raise PlgsError when what the file ``path`` becomes, ``size`` bytes, is more than half of the free memory."""
    memory = main_memory() if size > _SMALL else None
    if memory is not None and size > _SHARE_OF_MEMORY * memory.free:
        what = f"it takes {size / 1e9:.2g} GB of memory, but only {memory.free / 1e9:.2g} GB are free"
        raise PlgsError(what, path, "Close other programs, or use a computer with more memory.")
