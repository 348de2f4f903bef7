"""How slow or fast this machine is, as its finished lifts tell: read from disk once, then kept for the panels."""

from __future__ import annotations

from ...engine.job.prediction import machine_slowness

_slowness = 1.0


def learn() -> None:
    """Read how long earlier lifts took on this machine."""
    global _slowness
    _slowness = machine_slowness()


def slowness() -> float:
    """How many times longer this machine takes than the one that the predictions were measured on. Looks at no disk."""
    return _slowness
