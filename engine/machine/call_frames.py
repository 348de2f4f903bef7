"""Room for Python's frames while a compiler runs.

CPython (since 3.11) keeps the frames of calls in blocks of 16 KiB, and gives a block back to the system as soon as its
last frame is gone. A loop whose calls begin at the edge of a block asks the system for memory at every call. Numba's
compiler is deep enough for that to happen again and again: compiling the rasteriser's forward pass asked 350 000 times
(``strace -c``), 14 s instead of 10 (3.11, Cascade Lake). A frame that is larger than a block gets a larger one, and
those that follow find room in it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

Result = TypeVar("Result")

_WORDS = 33_000
"""A little more than 256 KiB: the block is then 512 KiB, of which the rest is left."""


def with_room(function: Callable[..., Result], *arguments: Any) -> Result:
    """The function's result; what it calls finds room for some 250 KiB of frames."""
    return function(*arguments)


# as if it had so many things to keep on its stack
with_room.__code__ = with_room.__code__.replace(co_stacksize=_WORDS)
