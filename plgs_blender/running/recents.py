"""Lifts of late, of this Blender and others: so that one can be found again that goes on, or has ended meanwhile."""

from __future__ import annotations

from ...engine.job.recent import RecentLift, recent_lifts

SHOWN = 8
"""So many the panel lists."""

_recent: tuple[RecentLift, ...] = ()


def refresh() -> None:
    """Look at the user's list of lifts: takes some milliseconds."""
    global _recent
    _recent = tuple(recent_lifts(most=SHOWN))


def recent() -> tuple[RecentLift, ...]:
    """The lifts as they were at the last `refresh`, the newest first. Looks at no disk."""
    return _recent
