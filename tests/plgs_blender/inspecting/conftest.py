"""A placed lift, with the extension switched on."""

from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender import lift_scene


@pytest.fixture
def root(extension: None, lift: Path) -> bpy.types.Collection:
    """The collection of the tiny lift in the open scene."""
    placed = lift_scene.place_lift(lift, bpy.context.scene)
    bpy.context.view_layer.update()
    return placed
