"""Paths as users type them into Blender."""

from __future__ import annotations

from pathlib import Path

import bpy


def absolute(path: str) -> Path:
    """A path made absolute, where "//" is the .blend's folder; without a trailing slash."""
    return Path(bpy.path.abspath(path)).absolute()


def free_lift_folder(scene_folder: Path) -> Path:
    """A folder beside the scene's that is not there yet: "room_lift", or "room_lift_2" and so on."""
    base = scene_folder.with_name(f"{scene_folder.name}_lift")
    number, folder = 1, base
    while folder.exists():
        number += 1
        folder = base.with_name(f"{base.name}_{number}")
    return folder
