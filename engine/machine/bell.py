"""A bell that a thread listens for a moment before it goes to sleep.

Waking a thread takes as long as a small kernel runs, and kernels follow one another within microseconds. So who waits
looks at a counter for a little while first; longer than that nobody spins, for then the core belongs to others.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from .compiled import Array, compiled

LOOKS = 150_000
"""About a tenth of a millisecond where it was measured."""


def new_bell() -> NDArray[np.int64]:
    """A counter that every ring raises, in a cache line of its own."""
    return np.zeros(8, np.int64)


def _counter(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> ir.Value:
    return context.make_array(signature.args[0])(context, builder, arguments[0]).data


@intrinsic
def _rings(typing_context: Any, bell: Any) -> Any:
    """How often it rang; what was written before the ring can be seen."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(_counter(context, builder, signature, arguments), "acquire", 8)

    return types.int64(bell), emit


@intrinsic
def _rest(typing_context: Any) -> Any:
    """Let the compiler keep the loop around it."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        nothing = ir.FunctionType(ir.VoidType(), [])
        builder.asm(nothing, "", "~{memory}", [], True)
        return context.get_dummy_value()

    return types.void(), emit


@compiled
def listen(bell: Array, heard: int, looks: int) -> Any:
    """Wait until the bell has not rung ``heard`` times, or until one has looked so often; how often it
    rang."""
    rings = _rings(bell)
    for _ in range(looks):
        if rings != heard:
            break
        _rest()
        rings = _rings(bell)
    return rings
