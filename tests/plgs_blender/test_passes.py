"""The passes in the compositor, rendered without a window, against the arrays that were baked."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from blender_helpers import rendered
from plgs.engine.job import LiftFolder, write_manifest
from plgs.engine.scene import open_scene
from plgs.plgs_blender import compat, compositing, lift_scene, passes
from plgs.plgs_blender.materials import linear_rgba
from plgs.plgs_blender.pass_nodes import CRYPTO_CLASSES, CRYPTO_INSTANCES, PANOPTIC, PASSES, node_of, output_of
from plgs.plgs_blender.shot_names import numbered, sequences
from tiny_lift import CABINET_NAME, CHAIR_NAME, FRAMES, mend_manifest, write_passes, write_tiny_lift
from tiny_scene import CHAIR_ID, TinyView, tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene


def truth(name: str, size: tuple[int, int] = (64, 48), frames: int = FRAMES) -> TinyView:
    return trace_view(tiny_pose(int(name), frames), tiny_intrinsics(size), size)


def set_matte(scene: bpy.types.Scene, node: str, *names: str) -> None:
    """As a user does who picks instances, or classes, in one of the scene's Cryptomatte nodes."""
    node_of(compat.compositor_tree(scene), node).matte_id = ",".join(names)


def passes_scene() -> bpy.types.Scene:
    return bpy.data.scenes["PLGS tiny room passes"]


@pytest.fixture(params=[1, 2], ids=["new file", "placed again"])
def scene(lift: Path, tmp_path: Path, request: pytest.FixtureRequest) -> bpy.types.Scene:
    """The passes scene of a saved and opened file, placed once or twice."""
    for _ in range(request.param):
        lift_scene.save_lift(lift, tmp_path / "lift.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "lift.blend"))
    return passes_scene()


def test_pass_layers_reach_the_compositor_with_their_values(scene: bpy.types.Scene, lift: Path, tmp_path: Path) -> None:
    names = [marker.name for marker in scene.timeline_markers]
    assert names == sorted(path.stem for path in (lift / "result" / "passes").iterdir()) and len(names) >= 2
    for name in reversed(names):
        passes.show_view(scene, name)
        view = truth(name)
        assert np.array_equal(rendered(scene, "Instance", tmp_path)[..., 0], view.instance)
        assert np.array_equal(rendered(scene, "Semantic", tmp_path)[..., 0], view.semantic)
        assert np.allclose(rendered(scene, "Depth", tmp_path)[..., 0], view.depth, atol=1e-6)
        assert np.allclose(rendered(scene, "Combined", tmp_path), (view.colour / 255.0) ** 2.2, atol=1e-5)
        assert np.allclose(rendered(scene, "Confidence", tmp_path), 0.9)
        assert np.allclose(rendered(scene, "Entropy", tmp_path), 0.1)
        assert np.allclose(rendered(scene, "Normal", tmp_path)[..., :3], (0, 0, 1))


def test_the_compositor_gives_the_matte_of_a_named_instance(scene: bpy.types.Scene, tmp_path: Path) -> None:
    view = truth(scene.timeline_markers[0].name)
    passes.show_view(scene, scene.timeline_markers[0].name)
    pairs = ([CHAIR_NAME], {1}), ([CABINET_NAME], {2}), ([CHAIR_NAME, CABINET_NAME], {1, 2})
    for names, ids in pairs:
        set_matte(scene, CRYPTO_INSTANCES, *names)
        matte = rendered(scene, "Instance matte", tmp_path)[..., 0]
        assert np.array_equal(matte, np.isin(view.instance, list(ids)).astype(np.float32))
    set_matte(scene, CRYPTO_CLASSES, "chair")
    assert np.array_equal(rendered(scene, "Class matte", tmp_path)[..., 0], view.semantic == CHAIR_ID)


def test_class_and_instance_ids_are_shown_in_their_colours(scene: bpy.types.Scene, tmp_path: Path) -> None:
    view = truth(scene.timeline_markers[0].name)
    passes.show_view(scene, scene.timeline_markers[0].name)
    colours = rendered(scene, "Instance colours", tmp_path)
    for number, srgb in ((0, (0, 0, 0)), (1, (250, 180, 20)), (2, (20, 190, 220))):
        assert np.allclose(colours[view.instance == number], linear_rgba(srgb)[:3], atol=1e-5)
    colours = rendered(scene, "Class colours", tmp_path)
    assert np.allclose(colours[view.semantic == CHAIR_ID], linear_rgba((210, 70, 60))[:3], atol=1e-5)


def place_two_views(folder: Path, files: dict[str, str], sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """Place a lift of two frames with these names and files, with passes of these sizes."""
    room, old = write_tiny_scene(folder / "tiny room", frames=2, ground_truth=False), ("0000", "0001")
    names = dict(zip(old, files, strict=True))
    for path in sorted(room.rglob("000?.*")):
        path.rename(path.with_stem(names[path.stem]))
    text = (room / "panoptic.json").read_text()
    for name in old:
        text = text.replace(name, names[name])
    (room / "panoptic.json").write_text(text)
    lift = write_tiny_lift(folder / "lift", scene=room, bake=False)
    lift.passes_path.mkdir()
    for frame, size in zip(open_scene(room).frames, sizes, strict=True):
        write_passes(lift.passes_path / f"{files[frame.name]}.exr", frame, size)
    lift.manifest_path.unlink()
    own = {file: name for name, file in files.items() if name != file}
    write_manifest(lift.result_path, versions={}, seed=0, settings={}, timings={}, frames=own)
    lift_scene.place_lift(lift.path, bpy.context.scene)


def test_pass_file_numbers_may_have_more_digits_than_frame_names(tmp_path: Path) -> None:
    place_two_views(tmp_path, {"3": "0003", "12": "0012"}, ((64, 48), (64, 48)))
    scene = passes_scene()
    assert [marker.name for marker in scene.timeline_markers] == ["3", "12"]
    for name, index in (("12", 1), ("3", 0)):
        passes.show_view(scene, name)
        assert np.array_equal(rendered(scene, "Instance", tmp_path)[..., 0], truth(str(index), frames=2).instance)


def test_passes_without_numbers_are_switched_by_name(tmp_path: Path) -> None:
    """Two names that are no sequence, and pictures of different sizes."""
    place_two_views(tmp_path, {"left": "left", "right": "right"}, ((64, 48), (32, 24)))
    scene = passes_scene()
    for name, index, size in (("right", 1, (32, 24)), ("left", 0, (64, 48)), ("right", 1, (32, 24))):
        passes.show_view(scene, name)
        scene.render.resolution_x, scene.render.resolution_y = size
        view = truth(str(index), size, frames=2)
        assert np.array_equal(rendered(scene, "Instance", tmp_path)[..., 0], view.instance)
        set_matte(scene, CRYPTO_INSTANCES, CHAIR_NAME)
        assert np.array_equal(rendered(scene, "Instance matte", tmp_path)[..., 0], view.instance == 1)


def test_the_passes_of_the_first_view_are_shown_at_once(lift: Path, tmp_path: Path) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    scene = passes_scene()
    view = truth(scene.timeline_markers[0].name)
    tree = compat.compositor_tree(scene)
    shown = {node_of(tree, key).frame_offset + 1 for key in (CRYPTO_INSTANCES, CRYPTO_CLASSES)}
    assert shown == {int(scene.timeline_markers[0].name)}
    assert np.array_equal(rendered(scene, "Instance", tmp_path)[..., 0], view.instance)


def test_placing_a_lift_reads_no_pass_file(lift: Path) -> None:
    for _ in range(2):
        lift_scene.place_lift(lift, bpy.context.scene)
        image = node_of(compat.compositor_tree(passes_scene()), PASSES).image
        assert (image.has_data, image.type, image.source) == (False, "MULTILAYER", "SEQUENCE")
        assert image.filepath.endswith(f"{passes_scene().timeline_markers[0].name}.exr")


def bake_shot(lift: LiftFolder, files: dict[str, int], overscan: int = 0) -> None:
    """As if these views had been baked, each with what a frame of the scene shows."""
    frames = open_scene(lift.request.scene).frames
    for name, index in files.items():
        write_passes(lift.passes_path / f"{name}.exr", frames[index], (64, 48), overscan)
    mend_manifest(lift.path)


def test_a_baked_shot_has_a_scene_with_its_own_frame_range(tmp_path: Path) -> None:
    lift = write_tiny_lift(tmp_path / "lift")
    shown = {6: 3, 8: 5, 10: 9}
    bake_shot(lift, {f"dolly.{frame:04d}": index for frame, index in shown.items()} | {"still.0001": 2})
    mine = bpy.context.scene
    mine.render.fps, mine.render.pixel_aspect_x = 25, 1.5
    for _ in range(2):
        lift_scene.place_lift(lift.path, mine)
    scene = bpy.data.scenes["PLGS tiny room dolly"]
    assert (scene.frame_start, scene.frame_end, scene.frame_step) == (6, 10, 2)
    assert (scene.render.fps, scene.render.pixel_aspect_x) == (25, 1.5)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (64, 48)
    for frame, index in reversed(shown.items()):
        scene.frame_set(frame)
        assert np.array_equal(rendered(scene, "Instance", tmp_path)[..., 0], truth(str(index)).instance)
    set_matte(scene, CRYPTO_INSTANCES, CHAIR_NAME)
    assert np.array_equal(rendered(scene, "Instance matte", tmp_path)[..., 0], truth("3").instance == 1)
    still = bpy.data.scenes["PLGS tiny room still"]
    assert np.array_equal(rendered(still, "Instance", tmp_path)[..., 0], truth("2").instance)
    (lift.passes_path / "still.0001.exr").unlink()
    mend_manifest(lift.path)
    lift_scene.place_passes_anew(lift.path, mine)
    assert "PLGS tiny room still" not in bpy.data.scenes and "PLGS tiny room dolly" in bpy.data.scenes
    assert len([each for each in bpy.data.scenes if "passes" in each.name]) == 1


def test_a_shot_with_overscan_is_shown_in_its_display_window(tmp_path: Path) -> None:
    lift = write_tiny_lift(tmp_path / "lift")
    bake_shot(lift, {"wide.0001": 3}, overscan=4)
    lift_scene.place_lift(lift.path, bpy.context.scene)
    scene = bpy.data.scenes["PLGS tiny room wide"]
    assert (scene.render.resolution_x, scene.render.resolution_y) == (64, 48)
    shown = rendered(scene, "Instance", tmp_path)[..., 0]
    np.testing.assert_allclose(shown, truth("3").instance, atol=1e-4)  # Blender 5.3 interpolates what has overscan


def test_frames_before_0_have_a_compositor_scene_of_their_own(tmp_path: Path) -> None:
    lift = write_tiny_lift(tmp_path / "lift")
    bake_shot(lift, {"dolly.-0002": 3, "dolly.-0001": 5, "dolly.0000": 9, "dolly.0001": 2})
    lift_scene.place_lift(lift.path, bpy.context.scene)
    for name, shown in (("dolly before 0", {1: 3, 2: 5}), ("dolly", {0: 9, 1: 2})):
        scene = bpy.data.scenes[f"PLGS tiny room {name}"]
        assert (scene.frame_start, scene.frame_end) == (min(shown), max(shown))
        for frame, index in shown.items():
            scene.frame_set(frame)
            assert np.array_equal(rendered(scene, "Instance", tmp_path)[..., 0], truth(str(index)).instance)
    markers = bpy.data.scenes["PLGS tiny room dolly before 0"].timeline_markers
    assert [(marker.frame, marker.name) for marker in markers] == [(1, "dolly.-0002"), (2, "dolly.-0001")]


def test_the_active_camera_decides_which_passes_are_opened(tmp_path: Path) -> None:
    lift = write_tiny_lift(tmp_path / "lift")
    bake_shot(lift, {"my dolly-2.0001": 3, "my dolly-2.0002": 5, "still.0001": 2})
    mine = bpy.context.scene
    lift_scene.place_lift(lift.path, mine)
    frames, dolly, still = (bpy.data.scenes[f"PLGS tiny room {name}"] for name in ("passes", "my dolly-2", "still"))
    cameras = {name: bpy.data.objects.new(name, bpy.data.cameras.new(name)) for name in ("my dolly-2", "still", "new")}
    for camera in cameras.values():
        mine.collection.objects.link(camera)
    mine.frame_set(2)
    for name, expected in {"my dolly-2": dolly, "still": still, "new": frames}.items():
        mine.camera = cameras[name]
        assert passes.passes_scene_of(mine) == expected, name
        assert compositing.panoptic_of(mine) == node_of(compat.compositor_tree(expected), PANOPTIC)
    mine.camera = cameras["my dolly-2"]
    assert passes.open_passes(mine) == dolly and dolly.frame_current == 2
    assert passes.passes_scene_of(dolly) == dolly
    mine.camera = next(ob for ob in mine.objects if ob.get("frame"))
    assert passes.passes_scene_of(mine) == frames


def test_placing_a_lift_again_keeps_the_users_nodes_linked(lift: Path) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    tree = compat.compositor_tree(passes_scene())
    blur = tree.nodes.new("CompositorNodeBlur")
    tree.links.new(output_of(tree, "Depth"), blur.inputs[0])
    lift_scene.place_lift(lift, bpy.context.scene)
    tree = compat.compositor_tree(passes_scene())
    blur = next(node for node in tree.nodes if node.bl_idname == "CompositorNodeBlur")
    assert blur.inputs[0].is_linked and blur.inputs[0].links[0].from_socket.name == "Depth"


@pytest.mark.parametrize("key", ["Instance scale", "Class scale", "Class palette"])
def test_compositor_nodes_that_the_user_deleted_are_made_again(lift: Path, key: str) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    tree = compat.compositor_tree(passes_scene())
    tree.nodes.remove(node_of(tree, key))
    lift_scene.place_lift(lift, bpy.context.scene)
    assert node_of(compat.compositor_tree(passes_scene()), key)


@pytest.mark.parametrize(
    ("names", "first", "numbers"),
    [
        (["0000", "0008", "0016"], "0000", (0, 8, 16)),
        (["100", "80", "1200"], "80", (100, 80, 1200)),
        (["frame-0003.color", "frame-0011.color"], "frame-0003.color", (3, 11)),
        (["b2_7"], "b2_7", (7,)),
        *((names, "", None) for names in ([], ["left", "right"], ["a1", "b2"], ["01", "2"], ["99999999999"])),
        (["1305031102.175304", "1305031103.2"], "", None),
    ],
)
def test_numbered_pass_names_make_a_sequence(names: list[str], first: str, numbers: tuple[int, ...] | None) -> None:
    found = numbered(names)
    assert found is None if numbers is None else found is not None and (found.first, found.numbers) == (first, numbers)


def test_pass_names_are_grouped_into_image_sequences() -> None:
    names = ["dolly.0001", "dolly.0002", "dolly.-0001", "pan 2.0001", "poster", "a.1", "a.01"]
    assert sequences(names) == {
        "dolly": ["dolly.0001", "dolly.0002"], "dolly before 0": ["dolly.-0001"], "pan 2": ["pan 2.0001"],
        "poster": ["poster"], "a.1": ["a.1"], "a.01": ["a.01"],
    }  # fmt: skip
