"""Which of the twin blending kernels run: the vector ones, or the plain ones where those cannot."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

log = logging.getLogger("plgs.raster")

VARIABLE = "PLGS_RASTER_KERNELS"
"""Environment variable: ``vector``, ``plain``, or unset to let the machine decide."""


@dataclass(frozen=True, eq=False)
class Kernels:
    """The kernels of one name, for ``parallel_for``; the last two tell the floats of scratch for so many channels (and
    Gaussians in the longest list of a tile)."""

    name: str
    blend_forward: Callable[..., Any]
    blend_backward: Callable[..., Any]
    gather: Callable[..., Any]
    forward_scratch: Callable[[int, int], int]
    backward_scratch: Callable[[int], int]


def choose_kernels() -> Kernels:
    """By ``PLGS_RASTER_KERNELS``; raises ``ValueError`` when it holds anything unknown."""
    wish = os.environ.get(VARIABLE, "")
    if wish not in ("", "vector", "plain"):
        raise ValueError(f"{VARIABLE} is {wish!r}; it must be vector or plain, or not be set")
    if wish == "plain":
        return _plain()
    if wish == "vector":
        return _vector()
    return _vector_or_plain()


@cache
def _vector_or_plain() -> Kernels:
    try:
        return _vector()
    except Exception as error:  # a Numba or LLVM that we do not know: any kind of error, and the plain twins still work
        log.warning("the vector kernels do not work here (%s); using the plain ones, about five times slower", error)
        return _plain()


@cache
def _vector() -> Kernels:
    """Compiles the smallest kernel on the way, so that a machine that cannot run them says so here."""
    import numpy as np

    from ..machine.peak import multiply_add
    from .blending.vector import backward, backward_tile, forward, gather

    multiply_add(1, np.zeros(16, np.float32))
    return Kernels(
        "vector",
        forward.blend_forward,
        backward.blend_backward,
        gather.gather,
        forward.scratch_size,
        backward_tile.scratch_size,
    )


@cache
def _plain() -> Kernels:
    from .blending import backward, forward, gather

    def none(*sizes: int) -> int:
        return 0

    return Kernels("plain", forward.blend_forward, backward.blend_backward, gather.gather, none, none)
