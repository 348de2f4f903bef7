"""What this Blender renders with Cryptomatte and index passes, 5.2 in one part a pass, is read as masks."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from engine.scene.masks import open_masks

CHAIRS = {"Chair.001": 7, "Chair.002": 9}
"""Their pass indices; the floor's is 2. Materials have the numbers of NYU40."""


@pytest.fixture
def scene(tmp_path: Path) -> bpy.types.Scene:
    """A floor seen from above, with two chairs on it, the first at the left."""
    scene = bpy.context.scene
    render, layer = scene.render, scene.view_layers[0]
    render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    render.resolution_x, render.resolution_y, render.resolution_percentage = 64, 48, 100
    material = {name: bpy.data.materials.new(name) for name in ("Wood", "Cloth")}
    material["Wood"].pass_index, material["Cloth"].pass_index = 2, 5
    bpy.ops.mesh.primitive_plane_add(size=8)
    placed = [("Floor", 2, "Wood")]
    for (name, number), x in zip(CHAIRS.items(), (-1.0, 1.0), strict=True):
        bpy.ops.mesh.primitive_cube_add(location=(x, 0.0, 0.5), size=1.0)
        placed.append((name, number, "Cloth"))
    for ob, (name, number, of) in zip(list(scene.objects), placed, strict=True):
        ob.name, ob.pass_index = name, number
        ob.data.materials.append(material[of])
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.location = (0.0, 0.0, 5.0)
    scene.collection.objects.link(scene.camera)
    layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = True
    layer.use_pass_object_index = layer.use_pass_material_index = True
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.filepath = str(tmp_path / "0001.exr")
    return scene


@pytest.mark.parametrize("depth", ["16", "32"])
def test_a_render_is_read_as_masks(scene: bpy.types.Scene, tmp_path: Path, depth: str) -> None:
    """With half floats, too: Blender keeps 32 bits for Cryptomatte and for indices."""
    scene.render.image_settings.color_depth = depth
    bpy.ops.render.render(write_still=True)
    by_name = open_masks(tmp_path, ["0001"])
    by_number = open_masks(tmp_path, ["0001"], "object-index", "nyu40:1-40")
    assert any('"ViewLayer.CryptoObject", not of "ViewLayer.CryptoMaterial"' in one for one in by_name.warnings)
    for found, floor in ((by_name, "Floor"), (by_number, "floor")):
        mask = found.readers["0001"]()
        name = {one.id: found.classes[one.class_id].name for one in mask.segments}
        shown = np.vectorize(lambda number, name=name: name[number].casefold())(mask.ids)
        assert shown[24, 20] == shown[24, 44] == "chair" and shown[2, 2] == floor.casefold()
        assert set(shown.ravel()) == {"chair", "floor"} and mask.ids[24, 20] != mask.ids[24, 44]
        assert 0.1 < (shown == "chair").mean() < 0.5
    tracks = {one.track for one in by_number.readers["0001"]().segments if one.is_thing}
    assert tracks == {*CHAIRS.values()}
