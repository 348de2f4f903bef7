"""The lift from end to end: what the engine does with a lift folder."""

from __future__ import annotations

from .bake_more import BakeOptions, bake_cameras, bake_frames
from .run import run_lift
from .warm_up import warm_up

__all__ = ["BakeOptions", "bake_cameras", "bake_frames", "run_lift", "warm_up"]
