"""What the open Blender file holds, and a scene that renders what a frame's camera sees, at the frame's size."""

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


def look_through(scene: bpy.types.Scene, ob: bpy.types.Object) -> None:
    """Make one of our cameras the scene's, with the size and pixel aspect of its frame: what is rendered then lies on
    the photo pixel by pixel.
    """
    render = scene.render
    scene.camera = ob
    render.resolution_x, render.resolution_y, render.resolution_percentage = ob["width"], ob["height"], 100
    aspect = ob["fx"] / ob["fy"]
    render.pixel_aspect_x, render.pixel_aspect_y = (1.0, aspect) if aspect >= 1.0 else (1.0 / aspect, 1.0)
