"""The lift from end to end: what the engine does with a lift folder."""

from __future__ import annotations

from .run import run_lift

__all__ = ["run_lift"]
