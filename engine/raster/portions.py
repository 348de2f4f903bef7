"""Gaussians are dealt out in portions: who is done with one takes the next. With equal shares, the slowest worker, or
one that wakes late, would hold up all others."""

from __future__ import annotations

from typing import Any

from ..machine.atomics import take_next
from ..machine.compiled import Array, part

PORTION = 256
"""Gaussians, about: fewer would leave too many blocks of lanes half empty, of which each portion begins new ones."""
MOST_PORTIONS = 256
"""Some for each of many workers; whoever lists the visible of a portion adds up the counts of all before it."""


@part
def portion_count(count: int) -> int:
    """How many portions so many Gaussians make: one at least."""
    return max(1, min(MOST_PORTIONS, (count + PORTION - 1) // PORTION))


@part
def range_of(portion: int, portions: int, count: int) -> Any:
    """The first of ``count`` Gaussians that belongs to a portion, and the first of the next one."""
    return count * portion // portions, count * (portion + 1) // portions


@part
def take_portion(next_portion: Array, portions: int, count: int) -> Any:
    """As ``range_of`` for the portion whose turn it is; an empty range when all have been taken."""
    first, end = range_of(take_next(next_portion), portions, count)
    return first, min(end, count)
