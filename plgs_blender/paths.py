"""Paths as users type them into Blender, and new folders beside theirs."""

from __future__ import annotations

from pathlib import Path

import bpy


def absolute(path: str) -> Path:
    """A path made absolute, where "//" is the .blend's folder; without a trailing slash."""
    return Path(bpy.path.abspath(path)).absolute()


def free_folder(beside: Path, ending: str) -> Path:
    """A folder that is not there yet: ``beside`` with the ending "lift" is "room_lift", or "room_lift_2" and so on."""
    number, folder = 1, beside.with_name(f"{beside.name}_{ending}")
    while folder.exists():
        number += 1
        folder = beside.with_name(f"{beside.name}_{ending}_{number}")
    return folder
