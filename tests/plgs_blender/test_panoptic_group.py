"""The compositor's group "PLGS Panoptic", rendered without a window, against the same sums in numpy."""

import colorsys
import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import cv2
import numpy as np
import pytest
from blender_helpers import rendered
from plgs.engine.job import write_manifest
from plgs.engine.scene import open_scene
from plgs.plgs_blender import compat, compositing, lift_scene
from plgs.plgs_blender.inspecting.lists import registered
from plgs.plgs_blender.materials import linear_rgba
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.pass_nodes import LINE_PIXELS, NAME, PANOPTIC, node_of
from plgs.plgs_blender.passes import show_view
from tiny_lift import FRAMES, write_passes
from tiny_scene import CABINET_ID, TinyView, tiny_intrinsics, tiny_pose, trace_view

from tests.raises_key import raises_key

CHAIR, CABINET = 1, 2


@pytest.fixture
def root(lift: Path) -> Iterator[bpy.types.Collection]:
    with registered():
        lift_scene.place_lift(lift, bpy.context.scene)
        (found,) = lifts_in(bpy.context.scene)
        yield found


@pytest.fixture
def scene(root: bpy.types.Collection) -> bpy.types.Scene:
    """With nothing but the picture to be seen."""
    scene, tree = next(compositing.compositors_of(root))
    node_of(tree, PANOPTIC).inputs["Overlay"].default_value = 0.0
    show_view(scene, scene.timeline_markers[1].name)
    return scene


@pytest.fixture
def view(scene: bpy.types.Scene) -> TinyView:
    """What the passes hold."""
    name = scene.timeline_markers[1].name
    return trace_view(tiny_pose(int(name), FRAMES), tiny_intrinsics((64, 48)), (64, 48))


def shown(scene: bpy.types.Scene, output: str, folder: Path, **controls: float | tuple[float, ...]) -> np.ndarray:
    """What an output of the group gives, float32 [H, W, 4], with these of its inputs set."""
    for name, value in controls.items():
        node_of(compat.compositor_tree(scene), PANOPTIC).inputs[name.replace("_", " ")].default_value = value
    return rendered(scene, output, folder, "RGBA")


def picture(view: TinyView) -> np.ndarray:
    """The passes' colours, linear, float64 [H, W, 4]."""
    return np.concatenate([(view.colour / 255.0) ** 2.2, np.ones((*view.depth.shape, 1))], axis=-1)


def ring(matte: np.ndarray) -> np.ndarray:
    """What lies within LINE_PIXELS around a matte, bool [H, W]."""
    side = 2 * LINE_PIXELS + 1
    return cv2.dilate(matte.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool) & ~matte


def test_mattes_match_ids(root: bpy.types.Collection, scene: bpy.types.Scene, view: TinyView, tmp_path: Path) -> None:
    for number in (CABINET, CHAIR):
        compositing.matte_instance(root, number)
        assert np.array_equal(shown(scene, "Matte", tmp_path)[..., 0], view.instance == number)
    for class_id in (CABINET_ID, 2):
        compositing.matte_class(root, class_id)
        assert np.array_equal(shown(scene, "Matte", tmp_path)[..., 0], view.semantic == class_id)
    compositing.matte_instance(root, CHAIR)
    assert np.array_equal(shown(scene, "Matte", tmp_path)[..., 0], view.instance == CHAIR)


def test_the_setting_isolate_shows_only_the_matte(
    root: bpy.types.Collection, scene: bpy.types.Scene, view: TinyView, tmp_path: Path
) -> None:
    compositing.matte_instance(root, CHAIR)
    matte = (view.instance == CHAIR)[..., None]
    alone = shown(scene, "Overlay", tmp_path, Outline=0.0, Isolate=1.0)
    assert np.allclose(alone, picture(view) * matte, atol=1e-5)
    half = shown(scene, "Overlay", tmp_path, Isolate=0.0, Hold_out=0.5)
    assert np.allclose(half, picture(view) * np.where(matte, 0.5, 1.0), atol=1e-5)


def test_the_compositor_draws_an_outline_of_the_matte(
    root: bpy.types.Collection, scene: bpy.types.Scene, view: TinyView, tmp_path: Path
) -> None:
    compositing.matte_instance(root, CHAIR)  # which turns the outline on, as nothing else shows the matte
    matte, colour = view.instance == CHAIR, (0.2, 0.7, 0.1, 1.0)
    seen = shown(scene, "Overlay", tmp_path, Outline_colour=colour)
    line = ring(matte)
    assert 20 < line.sum() and np.array_equal(shown(scene, "Outline", tmp_path)[..., 0], line)
    assert np.allclose(seen, np.where(line[..., None], colour, picture(view)), atol=1e-5)
    cut = shown(scene, "Overlay", tmp_path, Isolate=1.0)
    assert np.allclose(cut, np.where((line | matte)[..., None], seen, 0.0), atol=1e-5)


def test_a_recoloured_object_keeps_its_shading(
    root: bpy.types.Collection, scene: bpy.types.Scene, view: TinyView, tmp_path: Path
) -> None:
    compositing.matte_instance(root, CHAIR)
    matte, colour = view.instance == CHAIR, (0.1, 0.3, 0.8, 1.0)
    seen = shown(scene, "Overlay", tmp_path, Outline=0.0, Recolour=1.0, Recolour_to=colour)
    before = picture(view)
    assert np.allclose(seen[~matte], before[~matte], atol=1e-5)
    hue, saturation, _ = colorsys.rgb_to_hsv(*colour[:3])
    expected = [colorsys.hsv_to_rgb(hue, saturation, max(pixel)) for pixel in before[matte][:, :3]]
    assert np.allclose(seen[matte][:, :3], expected, atol=1e-4)


def test_the_compositor_shows_a_clean_plate_or_its_difference(
    lift: Path, scene: bpy.types.Scene, view: TinyView, tmp_path: Path
) -> None:
    """The other view's picture stands in for that of a plate."""
    tree, other = compat.compositor_tree(scene), scene.timeline_markers[0].name
    node = compat.new_node(tree, "CompositorNodeImage")
    node.image = bpy.data.images.load(str(lift / "result/passes" / f"{other}.exr"))
    _ = node.image.size[:]  # Blender must read a file before a node can name one of its layers
    node.layer = "PLGS"
    tree.links.new(node.outputs["Combined"], node_of(tree, PANOPTIC).inputs["Plate"])
    before = picture(view)[..., :3]
    plate = picture(trace_view(tiny_pose(int(other), FRAMES), tiny_intrinsics((64, 48)), (64, 48)))[..., :3]
    assert np.allclose(shown(scene, "Overlay", tmp_path)[..., :3], before, atol=1e-5)
    assert np.allclose(shown(scene, "Overlay", tmp_path, Clean_plate=1.0)[..., :3], plate, atol=1e-5)
    seen = shown(scene, "Overlay", tmp_path, Clean_plate=0.0, Difference=1.0)
    assert np.allclose(seen[..., :3], np.abs(before - plate), atol=1e-5)


def test_the_compositor_can_tint_guessed_pixels(lift: Path, view: TinyView, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(lift, tmp_path / "mine"))
    for frame in open_scene(lift.parent / "tiny room").test_frames:
        write_passes(mine / "result/passes" / f"{frame.name}.exr", frame, frame.size, guessed=CHAIR)
    write_manifest(mine / "result", versions={}, seed=0, settings={}, timings={})
    scene, _ = next(compositing.compositors_of(lift_scene.place_lift(mine, bpy.context.scene)))
    show_view(scene, scene.timeline_markers[1].name)
    pink, chair = (0.9, 0.1, 0.7, 1.0), (view.instance == CHAIR)[..., None]
    seen = shown(scene, "Overlay", tmp_path, Overlay=0.0, Guessed=0.5, Guessed_colour=pink)
    assert np.allclose(seen, picture(view) * np.where(chair, 0.5, 1.0) + chair * 0.5 * np.array(pink), atol=1e-5)


def test_the_class_overlay_is_mixed_over_the_picture(
    root: bpy.types.Collection, scene: bpy.types.Scene, view: TinyView, tmp_path: Path
) -> None:
    before = picture(view)
    seen = shown(scene, "Overlay", tmp_path, Overlay=0.4)
    assert_mixed(seen, before, view.instance == CABINET, (20, 190, 220))
    assert np.allclose(seen[view.instance == 0], before[view.instance == 0], atol=1e-5)
    seen = shown(scene, "Overlay", tmp_path, By_class=1.0)
    assert_mixed(seen, before, view.semantic == 2, (120, 90, 60))


def assert_mixed(seen: np.ndarray, before: np.ndarray, where: np.ndarray, srgb: tuple[int, int, int]) -> None:
    """Of the colour 0.4, of the picture the rest."""
    expected = 0.6 * before[where][:, :3] + 0.4 * linear_rgba(srgb)[:3]
    assert np.allclose(seen[where][:, :3], expected, atol=1e-5)


def test_the_node_group_keeps_the_users_settings(lift: Path, root: bpy.types.Collection) -> None:
    _, tree = next(compositing.compositors_of(root))
    node_of(tree, PANOPTIC).inputs["Hold out"].default_value = 0.25
    lift_scene.place_lift(lift, bpy.context.scene)
    _, tree = next(compositing.compositors_of(root))
    assert node_of(tree, PANOPTIC).inputs["Hold out"].default_value == 0.25
    assert [group.name for group in bpy.data.node_groups if group.name.startswith(NAME)] == [NAME]


def test_a_matte_without_baked_passes_is_refused(lift: Path, root: bpy.types.Collection) -> None:
    scene, _ = next(compositing.compositors_of(root))
    bpy.data.scenes.remove(scene)
    with raises_key("no-passes"):
        compositing.matte_instance(root, CHAIR)
    assert compositing.panoptic_of(bpy.context.scene) is None
