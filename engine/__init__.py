"""PLGS itself: panoptic lifting with structured 3D Gaussians. Never imports bpy."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:  # `read_lift` is imported late, as Blender needs none of it
    if name == "read_lift":
        return import_module(".lift_arrays", __name__).read_lift
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
