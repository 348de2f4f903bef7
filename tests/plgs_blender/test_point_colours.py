"""The points' colours in pixels: of classes in Solid shading, of the photos in Cycles and EEVEE."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.compat import use_nodes
from plgs.plgs_blender.viewport import show_object_colours
from tiny_scene import CATEGORIES, CHAIR_ID, FLOOR_ID

EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"
SIZE = 160, 120
COLOUR = {each["id"]: np.array(each["color"]) for each in CATEGORIES}


def render(engine: str, path: Path) -> np.ndarray:
    """The room as the frame 0003 saw it, sRGB bytes [H, W, 3], without boxes."""
    scene = bpy.context.scene
    scene.render.engine = engine
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "PNG"
    scene.cycles.samples, scene.cycles.use_denoising = 4, False
    scene.eevee.taa_render_samples = 4
    scene.world = bpy.data.worlds.new("black")
    background = next(node for node in use_nodes(scene.world).nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    show_object_colours(scene.display.shading)
    for ob in scene.objects:
        if "instance_id" in ob:
            ob.hide_render = True
    scene.frame_set(next(marker.frame for marker in scene.timeline_markers if marker.name == "0003"))
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    pixels = np.zeros(SIZE[0] * SIZE[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return np.round(255.0 * pixels.reshape(SIZE[1], SIZE[0], 4)[::-1, :, :3])


def share(picture: np.ndarray, colour: np.ndarray, within: int) -> float:
    """Share of the pixels whose channels are all `within` a colour's."""
    return float((np.abs(picture - colour).max(axis=-1) <= within).mean())


def test_classes_in_solid_shading(lift: Path, tmp_path: Path) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    picture = render("BLENDER_WORKBENCH", tmp_path / "solid.png")
    assert share(picture, COLOUR[CHAIR_ID], 14) > 0.02
    assert share(picture, COLOUR[FLOOR_ID], 14) > 0.05


@pytest.mark.parametrize("engine", ["CYCLES", pytest.param(EEVEE, marks=pytest.mark.slow)])
def test_photo_colours_in_renders(lift: Path, tmp_path: Path, engine: str) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    chair = next(ob for ob in root.all_objects if ob.name == "chair")
    green = np.tile(np.array([0.0, 1.0, 0.0, 1.0], np.float32), (len(chair.data.points), 1))
    chair.data.attributes["Col"].data.foreach_set("color", green.ravel())
    picture = render(engine, tmp_path / "photo.png")
    assert share(picture, np.array([0, 255, 0]), 30) > 0.02, "what Col says, not the class's colour"
