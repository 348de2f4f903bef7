"""Calls a compiler so that Python's management of memory does not slow it down.

CPython (since 3.11) keeps the frames of calls in blocks of 16 KiB, and gives a block back to the system as soon as its
last frame is gone. A loop whose calls begin at the edge of a block asks the system for memory at every call. Numba's
compiler is deep enough for that to happen again and again: compiling the rasteriser's forward pass asked 350 000 times
(``strace -c``), 14 s instead of 10 (3.11, Cascade Lake). A frame that is larger than a block gets a larger one, and
those that follow find room in it.

The compiler also makes so many objects, of which most live on, that Python's search for cycles of dead ones takes a
twelfth of the time (the forward pass in a busy hour, 3.11: 1.3 of 16 s in 769 searches, by ``gc.callbacks``). Without
it the process holds 55 MB more until the next search.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from typing import Any, TypeVar

Result = TypeVar("Result")

_WORDS = 33_000
"""A little more than 256 KiB: the block is then 512 KiB, of which the rest is left."""


def undisturbed(function: Callable[..., Result], *arguments: Any) -> Result:
    """The function's result; nobody looks for dead cycles meanwhile, and what it calls finds room for some 250 KiB of
    frames."""
    looked_for_cycles = gc.isenabled()
    try:  # an interrupt may come as soon as it is switched off
        if looked_for_cycles:
            _switched_off.append(True)
            gc.disable()
        return function(*arguments)
    finally:
        if looked_for_cycles:
            _switched_off.clear()
            gc.enable()


# as if it had so many things to keep on its stack
undisturbed.__code__ = undisturbed.__code__.replace(co_stacksize=_WORDS)

_switched_off: list[bool] = []
"""Something while a call has it switched off."""


def _switch_on() -> None:
    """In a forked process, where the thread that would does not follow."""
    if _switched_off:
        gc.enable()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_switch_on)
