"""Where to look from."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from plgs.engine.errors import PlgsError
from plgs.engine.scene import open_scene
from plgs.plgs_blender.inspecting import views
from plgs.plgs_blender.inspecting.highlight import outline_in_space
from plgs.plgs_blender.inspecting.selection import boxes_of, objects_by_key, row_of
from plgs.plgs_blender.owned import SCENE


def test_the_best_view_is_that_of_the_largest_mask(root: bpy.types.Collection) -> None:
    row = row_of(root, 1)
    frame = views.best_frame(root, 1)
    assert frame == row.masks[row.best_mask].frame == row.masks[row.mask_index].frame
    whole = [m.share for m in row.masks if min(m.rectangle[:2]) > 0.0 and max(m.rectangle[2:]) < 1.0]
    assert row.masks[row.best_mask].share == max(whole)
    held_out = {frame.name for frame in open_scene(root[SCENE]).test_frames}  # type: ignore[arg-type]
    assert frame not in held_out


def test_looking_from_a_frame_goes_there_on_the_timeline(root: bpy.types.Collection) -> None:
    scene = bpy.context.scene
    scene.render.resolution_x = 333
    view = next(s for screen in bpy.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D")
    camera = views.look_from_frame(root, "0005", scene, view)
    assert scene.camera == camera and camera["frame"] == "0005"
    assert scene.frame_current == next(m.frame for m in scene.timeline_markers if m.name == "0005")
    assert view.region_3d.view_perspective == "CAMERA"
    assert scene.render.resolution_x == 333, "the size of the user's renders is theirs"
    bpy.data.objects.remove(camera)
    with pytest.raises(PlgsError, match="no camera of frame 0005"):
        views.look_from_frame(root, "0005", scene)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.2])
def test_a_framed_box_fills_the_view_and_no_more(root: bpy.types.Collection, aspect: float) -> None:
    view = next(s for screen in bpy.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D")
    region = view.region_3d
    region.view_perspective = "PERSP"
    turned = region.view_rotation.copy()
    views.frame_instance(root, 1, view, aspect)
    box = boxes_of(root)[1]
    corners = np.array([box.matrix_world @ Vector(corner) for corner in box.bound_box])
    assert np.allclose(region.view_location, corners.mean(axis=0), atol=1e-6) and region.view_rotation == turned
    radius = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()
    # Blender's view of a lens: 72 mm along the longer side.
    half = 36.0 / view.lens * min(1.0, 1.0 / aspect if aspect > 1.0 else aspect)
    fills = radius / (region.view_distance * half)
    assert 0.4 < fills < 1.0


TWO_POLYGONS = "0.250,0.100 0.750,0.100 0.750,0.600 0.250,0.600;0.000,0.000 1.000,0.000 1.000,1.000"


@pytest.mark.parametrize("outline", ["", TWO_POLYGONS])
def test_an_outline_matches_the_photo(outline: str, root: bpy.types.Collection) -> None:
    camera = objects_by_key(root)["frame:0003"]
    scene = bpy.context.scene
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    bpy.context.view_layer.update()
    rectangle = (0.25, 0.1, 0.75, 0.6)
    polygons = outline_in_space(camera, outline, rectangle)
    seen = [[world_to_camera_view(scene, camera, corner)[:2] for corner in polygon] for polygon in polygons]
    assert np.allclose(seen[0], [(0.25, 0.9), (0.75, 0.9), (0.75, 0.4), (0.25, 0.4)], atol=1e-4)
    assert not outline or np.allclose(seen[1], [(0, 1), (1, 1), (1, 0)], atol=1e-4)
