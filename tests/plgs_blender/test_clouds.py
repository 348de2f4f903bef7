"""Points become clouds, each class its own, with normals, an overview, and colours in pixels."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from blender_helpers import values_of
from plgs.engine.result_files import Anchors, SemanticPoints
from plgs.engine.scene import Category, ClassTable
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.cameras import overview_camera
from plgs.plgs_blender.clouds import SurfaceGrid, place_anchors, place_semantic_points
from plgs.plgs_blender.compat import use_nodes
from plgs.plgs_blender.owned import OwnedDataBlocks
from plgs.plgs_blender.viewport import show_object_colours
from tiny_scene import CATEGORIES, CHAIR_ID, FLOOR_ID

CLASSES = ClassTable(tuple(Category(k, f"class {k}", k > 3, (10 * k, 250 - 9 * k, 5 * k)) for k in range(1, 22)))


def many_points(count: int) -> SemanticPoints:
    """Unordered points on the faces of a room of 8 x 6 x 2.7 m, of 22 classes (0 = unknown) and 60 instances."""
    random = np.random.default_rng(0)
    size = np.array([8.0, 6.0, 2.7])
    face, xyz = random.integers(0, 6, count), random.random((count, 3)) * size
    xyz[np.arange(count), face // 2] = (face % 2) * size[face // 2]
    xyz += random.normal(0.0, 0.004, (count, 3))
    return SemanticPoints(
        xyz.astype(np.float32),
        random.integers(0, 256, (count, 3)).astype(np.uint8),
        random.integers(0, 22, count).astype(np.int32),
        random.integers(0, 60, count).astype(np.int32),
        random.random(count, np.float32),
    )


def place(points: SemanticPoints) -> list[bpy.types.Object]:
    """The clouds; anchors are made as well, a quarter as many."""
    parent = bpy.data.collections.new("points")
    owned = OwnedDataBlocks("lift", bpy.context.scene)
    few = slice(0, len(points.xyz) // 4)
    anchors = Anchors(
        points.xyz[few], points.class_id[few], points.instance_id[few], points.confidence[few],
        points.class_id[few] % 4, points.rgb[few],
    )  # fmt: skip
    viewpoints = np.random.default_rng(1).random((200, 3)) * [6.0, 4.0, 1.0] + 1.0
    grid = SurfaceGrid.of(points.xyz)
    clouds = place_semantic_points(owned, parent, points, grid=grid, normals=grid.normals(viewpoints), classes=CLASSES)
    place_anchors(owned, parent, anchors)
    return clouds


def test_every_class_has_a_point_cloud_of_its_own() -> None:
    points = many_points(2000)
    clouds = place(points)
    assert [cloud["class_id"] for cloud in clouds] == list(range(22))
    for cloud in clouds:
        mine = points.class_id == cloud["class_id"]
        assert np.array_equal(values_of(cloud.data, "position", "vector", 3), points.xyz[mine])
        assert np.array_equal(values_of(cloud.data, "instance_id"), points.instance_id[mine])
        assert np.array_equal(values_of(cloud.data, "confidence"), points.confidence[mine])


def room(step: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Points of the six faces of a 4 x 3 x 2.5 room, away from its edges, and their inward normals."""
    size = np.array([4.0, 3.0, 2.5])
    xyz, normals = [], []
    for axis in range(3):
        others = [each for each in range(3) if each != axis]
        grids = np.meshgrid(*(np.arange(0.3, size[each] - 0.3, step) for each in others))
        for side in (0.0, 1.0):
            face = np.zeros((grids[0].size, 3))
            face[:, axis] = side * size[axis]
            face[:, others[0]], face[:, others[1]] = grids[0].ravel(), grids[1].ravel()
            xyz.append(face)
            normals.append(np.tile(np.eye(3)[axis] * (1.0 - 2.0 * side), (len(face), 1)))
    return np.concatenate(xyz), np.concatenate(normals)


def test_normals_of_wall_points_face_the_cameras() -> None:
    xyz, inward = room()
    normals = SurfaceGrid.of(xyz.astype(np.float32)).normals(np.array([[2.0, 1.5, 1.5]]))
    agreement = np.einsum("ij,ij->i", normals, inward)
    assert (agreement > 0.0).all() and np.mean(agreement > 0.99) > 0.95


def test_the_overview_camera_shows_the_whole_room_from_outside() -> None:
    xyz, inward = room()
    camera = overview_camera(xyz, inward)
    facing = np.einsum("ij,ij->i", inward, camera.centre - xyz) > 0.0
    assert 0.3 < facing.mean() < 0.7
    pixels, depth = camera.project(xyz[facing])
    assert (depth > 0.0).all()
    assert (pixels > 0.0).all() and (pixels < [1280.0, 800.0]).all()
    assert (pixels.max(axis=0) - pixels.min(axis=0)).max() > 600.0
    assert camera.centre[2] > 2.5 and not (np.abs(camera.centre[:2] - [2.0, 1.5]) < [2.0, 1.5]).all()
    assert np.allclose(camera.camera_to_world[:3, :3] @ camera.camera_to_world[:3, :3].T, np.eye(3))
    assert np.linalg.det(camera.camera_to_world[:3, :3]) > 0.0


@pytest.mark.parametrize("origin", [(0, 0, 0), (100, 0, 0), (4000, 5000, 100)])
def test_far_noise_does_not_shrink_the_room_in_the_overview(origin: tuple[int, int, int]) -> None:
    xyz, inward = room()
    xyz = xyz + origin
    noise = np.random.default_rng(0).uniform(-15, 15, (len(xyz) // 120, 3)) + origin
    camera = overview_camera(np.concatenate([xyz, noise]), np.concatenate([inward, np.zeros_like(noise)]))
    facing = np.einsum("ij,ij->i", inward, camera.centre - xyz) > 0.0
    pixels, _ = camera.project(xyz[facing])
    assert (pixels > 0.0).all() and (pixels < [1280.0, 800.0]).all()
    assert (pixels.max(axis=0) - pixels.min(axis=0)).max() > 600.0


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


def test_solid_shading_shows_points_in_class_colours(lift: Path, tmp_path: Path) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    picture = render("BLENDER_WORKBENCH", tmp_path / "solid.png")
    assert share(picture, COLOUR[CHAIR_ID], 14) > 0.02
    assert share(picture, COLOUR[FLOOR_ID], 14) > 0.05


@pytest.mark.parametrize("engine", ["CYCLES", pytest.param(EEVEE, marks=pytest.mark.slow)])
def test_renders_show_points_in_photo_colours(lift: Path, tmp_path: Path, engine: str) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    chair = next(ob for ob in root.all_objects if ob.name == "chair points")
    green = np.tile(np.array([0.0, 1.0, 0.0, 1.0], np.float32), (len(chair.data.points), 1))
    chair.data.attributes["Col"].data.foreach_set("color", green.ravel())
    picture = render(engine, tmp_path / "photo.png")
    assert share(picture, np.array([0, 255, 0]), 30) > 0.02, "what Col says, not the class's colour"
