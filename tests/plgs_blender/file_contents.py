"""What the open Blender file holds."""

from __future__ import annotations

from typing import Any

import bpy

DATA = (
    "objects",
    "collections",
    "cameras",
    "meshes",
    "pointclouds",
    "materials",
    "node_groups",
    "images",
    "scenes",
)


def counts() -> dict[str, int]:
    return {kind: len(names) for kind, names in contents().items()}


def contents() -> dict[str, Any]:
    """The names of all blocks, but of the picture that Blender 5.3 keeps for itself while the compositor runs."""
    return {
        kind: sorted(block.name for block in getattr(bpy.data, kind) if getattr(block, "source", "") != "VIEWER")
        for kind in DATA
    }
