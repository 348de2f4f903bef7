"""Gaussians are dealt out in portions: who is done with one takes the next. Halves would wait for the slower worker,
and for one that has yet to wake up."""

from __future__ import annotations

from typing import Any

from ..machine.compiled import part

PORTION = 512
"""Gaussians, at least, where there are several portions."""
MOST_PORTIONS = 64


@part
def portion_count(count: int) -> int:
    """How many portions so many Gaussians make: one at least."""
    return max(1, min(MOST_PORTIONS, count // PORTION))


@part
def range_of(portion: int, count: int) -> Any:
    """The first Gaussian of a portion, and the first of the next one."""
    portions = portion_count(count)
    return count * portion // portions, count * (portion + 1) // portions
