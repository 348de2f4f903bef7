"""The lift from end to end: reads a lift folder's request, and writes its result."""

from __future__ import annotations

from .bake_more import BakeOptions, bake_cameras, bake_frames
from .run import run_lift
from .warm_up import warm_up

__all__ = ["BakeOptions", "bake_cameras", "bake_frames", "run_lift", "warm_up"]
