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
    return {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in DATA}
