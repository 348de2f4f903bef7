"""Captures of other layouts into Blender, with what only an engine can make of them, and pictures on demand."""

import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import bpy
import numpy as np
import pytest
from blender_helpers import values_of
from plgs.engine.scene import open_scene
from plgs.plgs_blender import import_scene, registry
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.frame_pictures import colours_shown, read_cloud
from plgs.plgs_blender.running import importing
from plgs.plgs_blender.running.importing import FrameMaking, FrameOrder, make_frames
from plgs.plgs_blender.settings import chosen_scene

from tests.raises_key import raises_key, worded
from tests.scene.formats.room import distance_to_room


@pytest.fixture
def own(captures: Path, tmp_path: Path) -> Iterator[Path]:
    """The captures, in a folder of this test's own."""
    yield Path(shutil.copytree(captures, tmp_path / "captures"))


def frames() -> dict[str, bpy.types.Object]:
    return {ob["frame"]: ob for ob in bpy.context.scene.objects if "frame" in ob}


def shown(ob: bpy.types.Object) -> np.ndarray:
    """What is before a camera's view, uint8 [H, W, 3] from the top."""
    image = ob.data.background_images[0].image
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    return np.rint(values.reshape(height, width, 4)[::-1, :, :3] * 255).astype(np.uint8)


def clouds(key: str = "cloud") -> list[bpy.types.Object]:
    return [ob for ob in bpy.context.scene.objects if ob.get("plgs_key") == key]


def positions(key: str = "cloud") -> np.ndarray:
    return np.concatenate([values_of(ob.data, "position", "vector", 3) for ob in clouds(key)])


def squares_of(ob: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Corners [N, 4, 3] and sRGB colours [N, 4, 3] of the squares that Blender draws, in Solid shading too."""
    mesh = ob.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert mesh.color_attributes.active_color.name == "Col" and len(mesh.polygons) == len(ob.data.vertices)
    corners = np.empty(4 * len(mesh.polygons), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    values = values_of(mesh, "position", "vector", 3), values_of(mesh, "Col", "color_srgb", 4)[:, :3]
    # Blender may number the squares otherwise than the points; a square's first corner in its mesh is its point.
    order = np.argsort(corners.reshape(-1, 4).min(axis=1))
    squares, colours = (value[corners].reshape(-1, 4, 3)[order] for value in values)
    return squares, colours


def test_importing_an_archive_adds_its_pictures_and_a_point_cloud(own: Path) -> None:
    assert bpy.ops.plgs.import_scene(scene_folder=str(own / "scans" / "one.sens"), format="sens") == {"FINISHED"}
    scene = open_scene(own / "scans" / "one.sens")
    assert [*frames()] == [frame.name for frame in scene.frames]
    for frame in scene.frames:
        assert np.abs(shown(frames()[frame.name]).astype(int) - frame.read_colour(None)).mean() < 3.0
    assert len(positions()) > 2000 and (distance_to_room(positions()) < 0.06).mean() > 0.97
    [cloud] = clouds()
    squares, colours = squares_of(cloud)
    assert np.allclose(squares.mean(axis=1), positions(), atol=1e-5), "a point is the middle of its square"
    stored = read_cloud(next((own / "scans" / "one_frames").glob("*.npz")))[1]
    assert np.array_equal(np.rint(colours * 255), np.repeat(stored[:, None], 4, axis=1)), "in its own colour, exactly"
    sides = np.linalg.norm(squares - np.roll(squares, 1, axis=1), axis=2)
    assert np.ptp(sides, axis=1).max() < 1e-4 and 0.0039 < sides.min() and sides.max() < 0.061
    eyes = np.array([ob.matrix_world.translation for ob in frames().values()])
    normals = np.cross(squares[:, 1] - squares[:, 0], squares[:, 2] - squares[:, 1])
    seen = (np.einsum("nc,nvc->nv", normals, eyes[None] - squares[:, None, 0]) > 0.0).any(axis=1)
    assert seen.mean() > 0.99, "a square shows its front to a camera"
    assert {each.name for each in (own / "scans").iterdir()} == {"one.sens", "two.sens", "one_frames"}


def test_a_plain_folder_is_imported_without_an_engine(
    room: Path, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor has Blender the packages that only the engine's Python has."""
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", "/nowhere/python")
    monkeypatch.setitem(sys.modules, "cv2", None)
    copy = shutil.copytree(room, tmp_path / "room")  # engines of other tests put clouds beside `room`
    assert bpy.ops.plgs.import_scene(scene_folder=str(copy)) == {"FINISHED"}
    assert len(frames()) == 8 and all(ob.data.background_images for ob in frames().values()) and not clouds()
    bpy.context.scene.camera = frames()["0002"]
    assert bpy.ops.plgs.show_picture(what="PHOTO") == {"FINISHED"}
    with pytest.raises(RuntimeError, match="nowhere"):
        bpy.ops.plgs.show_picture(what="DEPTH")
    with pytest.raises(RuntimeError, match=worded("needs-engine")):
        bpy.ops.plgs.import_scene(scene_folder=str(own / "scans" / "one.sens"))


def test_extracted_frames_are_reused_at_the_next_import(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = str(own / "scans" / "one.sens")
    bpy.ops.plgs.import_scene(scene_folder=place)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", "/nowhere/python")
    monkeypatch.setattr(import_scene, "has_cameras_of", lambda *_: pytest.fail("these cameras are the engine's own"))
    bpy.ops.plgs.import_scene(scene_folder=place)
    assert bpy.data.collections["PLGS one.sens"]["plgs_missing"] == ""
    assert all(ob.data.background_images for ob in frames().values())
    count, blocks = len(positions()), len(bpy.data.meshes)
    bpy.ops.plgs.import_scene(scene_folder=place)
    assert len(positions()) == count and len(bpy.data.meshes) == blocks, "importing again replaces the cloud"
    later = time.time() + 100
    os.utime(place, (later, later))
    bpy.ops.plgs.import_scene(scene_folder=place)
    assert bpy.data.collections["PLGS one.sens"]["plgs_missing"] == "colour cloud", "the scene is newer"


def test_a_cloud_of_other_poses_is_not_shown(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth was older than the cloud, so it stayed where the cameras had been."""
    place = Path(shutil.copytree(room, tmp_path / "room"))
    bpy.ops.plgs.import_scene(scene_folder=str(place))
    assert len(positions())
    for pose in (place / "pose").iterdir():
        moved = np.loadtxt(pose)
        moved[0, 3] += 0.5
        np.savetxt(pose, moved)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", "/nowhere/python")
    bpy.ops.plgs.import_scene(scene_folder=str(place))
    assert not clouds() and "cloud" in bpy.data.collections["PLGS room"]["plgs_missing"]


def test_bad_frames_do_not_hide_a_placed_cloud(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blender knows nothing of masks, and does not read depth, so it keeps these frames."""
    place = Path(shutil.copytree(room, tmp_path / "room"))
    (place / "panoptic" / "0002.png").unlink()
    for cut in (place / "panoptic" / "0003.png", place / "depth" / "0005.png"):
        cut.write_bytes(cut.read_bytes()[:60])
    bpy.ops.plgs.import_scene(scene_folder=str(place))
    count = len(positions())
    assert count and len(open_scene(place).frames) == len(frames()) - 3
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", "/nowhere/python")
    bpy.ops.plgs.import_scene(scene_folder=str(place))
    assert len(positions()) == count and bpy.data.collections["PLGS room"]["plgs_missing"] == ""


def test_sparse_points_are_imported_with_the_cameras(own: Path) -> None:
    assert bpy.ops.plgs.import_scene(scene_folder=str(own / "walk")) == {"FINISHED"}
    assert len(frames()) == 6 and all(ob.data.background_images for ob in frames().values())
    points = open_scene(own / "walk").points
    np.testing.assert_allclose(positions("sparse_points"), points.xyz, atol=1e-5)
    for frame in open_scene(own / "walk").frames:
        assert Path(frames()[frame.name].data.background_images[0].image.filepath) == frame.colour_path


def test_the_file_browser_chooses_a_scene_file(own: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.up = "-y"
    file = own / "studio" / "transforms.json"
    assert bpy.ops.plgs.browse_scene(filepath=str(file), cloud=False) == {"FINISHED"}
    assert len(frames()) == 6 and settings.up == "z" and Path(settings.scene_folder) == own / "studio"
    assert not clouds()
    with pytest.raises(RuntimeError, match="no such file"):
        bpy.ops.plgs.browse_scene(filepath=str(own / "nothing.json"))
    with pytest.raises(RuntimeError, match=worded("inner-scenes")):
        bpy.ops.plgs.browse_scene(filepath=str(own))


def test_depth_and_masks_are_shown_in_front_of_a_camera(room: Path) -> None:
    bpy.ops.plgs.import_scene(scene_folder=str(room), cloud=False)
    camera = frames()["0003"]
    bpy.context.scene.camera = camera
    photo = camera.data.background_images[0].image
    assert bpy.ops.plgs.show_picture(what="DEPTH") == {"FINISHED"}
    image = camera.data.background_images[0].image
    assert (image["near_metres"], image["far_metres"]) == pytest.approx((0.9, 3.3), abs=0.8)
    far_and_near = shown(camera).astype(int).sum(-1)
    assert far_and_near.shape == (48, 64) and far_and_near.max() > 2 * np.percentile(far_and_near, 20)
    assert bpy.ops.plgs.show_picture(what="MASKS") == {"FINISHED"}
    colours = {tuple(each) for each in shown(camera).reshape(-1, 3).tolist()}
    classes = {each.colour for each in open_scene(room).classes.categories}
    assert len(colours & classes) >= 3
    kept = colours_shown(camera) or set()
    assert len(kept) >= 3 and kept <= {red << 16 | green << 8 | blue for red, green, blue in colours}, "for a legend"
    assert bpy.ops.plgs.show_picture(what="PHOTO") == {"FINISHED"}
    assert camera.data.background_images[0].image == photo and camera.data.background_images[0].alpha == 1.0
    assert bpy.ops.plgs.show_picture(what="PHOTO") == {"FINISHED"} and camera.data.background_images[0].alpha == 0.5
    others = [ob for name, ob in frames().items() if name != "0003"]
    assert all(ob.data.background_images[0].image.name.startswith(ob["frame"]) for ob in others)


def test_all_cameras_show_the_same_kind_of_background_picture(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bpy.ops.plgs.import_scene(scene_folder=str(room), cloud=False)
    scene = bpy.context.scene
    scene.camera = frames()["0003"]
    assert bpy.ops.plgs.show_picture(what="MASKS") == {"FINISHED"}
    for name in ("0004", "0005"):
        scene.camera = frames()[name]
        assert importing.wanted(scene) == "MASKS"
        assert importing.catch_up() is None
        (making,) = registry.running(FrameMaking)
        registry.wait_for(making, scene)
        assert frames()[name]["plgs_shown"] == "MASKS" and not importing.wanted(scene)
    scene.camera = frames()["0006"]
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", "/nowhere/python")
    assert importing.catch_up() is None and not importing.wanted(scene), "without an engine photos stay"
    assert bpy.ops.plgs.show_picture(what="PHOTO") == {"FINISHED"}
    scene.camera = frames()["0004"]
    assert importing.catch_up() is None and frames()["0004"]["plgs_shown"] == "PHOTO"


def test_a_drawn_depth_picture_is_reused_until_its_file_changes(room: Path, tmp_path: Path) -> None:
    room = Path(shutil.copytree(room, tmp_path / "room"))
    bpy.ops.plgs.import_scene(scene_folder=str(room), cloud=False)
    scene = bpy.context.scene
    scene.camera = frames()["0003"]
    for what in ("DEPTH", "PHOTO"):
        assert bpy.ops.plgs.show_picture(what=what) == {"FINISHED"}
    assert importing.choose_picture(scene, "DEPTH") is None and frames()["0003"]["plgs_shown"] == "DEPTH"
    os.utime(room / "depth" / "0003.png", (2**32, 2**32))
    making = importing.choose_picture(scene, "DEPTH")
    registry.wait_for(making, scene)
    assert making.undo_step


def test_no_picture_is_made_while_the_animation_plays(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bpy.ops.plgs.import_scene(scene_folder=str(room), cloud=False)
    scene, at = bpy.context.scene, list[float]()
    scene.camera = frames()["0003"]
    assert bpy.ops.plgs.show_picture(what="DEPTH") == {"FINISHED"}
    scene.camera = frames()["0004"]
    timers = SimpleNamespace(
        is_registered=lambda function: bool(at),
        unregister=lambda function: at.clear(),
        register=lambda function, first_interval: at.append(first_interval),
    )
    jobs = {"RENDER"}
    app = SimpleNamespace(timers=timers, is_job_running=jobs.__contains__)
    monkeypatch.setattr(importing, "bpy", SimpleNamespace(app=app, context=bpy.context, data=bpy.data))
    importing._on_change(scene)
    assert not at and importing.catch_up() and not registry.running(FrameMaking), "not while a render runs"
    jobs.clear()
    importing._on_change(scene)
    at[:] = [0.01]  # it has waited
    importing._on_change(scene)
    assert len(at) == 1 and at[0] > 0.01, "each change sets it back"
    assert importing.catch_up() is None
    (making,) = registry.running(FrameMaking)
    registry.wait_for(making, scene)
    assert frames()["0004"]["plgs_shown"] == "DEPTH" and not making.undo_step, "nobody pressed a button"


def test_damaged_depth_is_reported(own: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The last frame's depth is damaged: pictures come, the cloud does not."""
    place = own / "scans" / "one.sens"
    place.write_bytes(place.read_bytes()[:-1000] + bytes(1000))
    assert bpy.ops.plgs.import_scene(scene_folder=str(place)) == {"FINISHED"}
    assert all(ob.data.background_images for ob in frames().values()) and not clouds()
    making = registry.latest(FrameMaking)
    assert making is not None and not making.is_running and making.error is not None
    assert "one.sens" in str(making.error) and "Warning" in capfd.readouterr().out
    assert bpy.data.collections["PLGS one.sens"]["plgs_missing"] == "cloud"
    settings, key = bpy.context.scene.plgs, frames()["5"]["plgs_lift"]
    assert making.error_for(chosen_scene(settings), "") == making.error_for(None, key) == making.error
    settings.scene_folder = str(own / "scans" / "two.sens")
    assert making.error_for(chosen_scene(settings), "") is None, "another scene has no such error"
    bpy.context.scene.camera = frames()["5"]
    with pytest.raises(RuntimeError, match=r"one\.sens"):
        bpy.ops.plgs.show_picture(what="DEPTH")
    bpy.ops.plgs.import_scene(scene_folder=str(own / "studio"), cloud=False)
    other = registry.latest(FrameMaking)
    assert other is None or other.error is None, "another import"


def test_disabling_the_extension_ends_its_engine(captures: Path, tmp_path: Path, plgs: ModuleType) -> None:
    chosen = ChosenScene(shutil.copytree(captures / "studio", tmp_path / "studio"))
    make_frames(FrameOrder(chosen, "nobody's", ("colour", "depth", "cloud")), Path(sys.executable))
    with raises_key("at-work"):
        make_frames(FrameOrder(chosen, "nobody's", ("depth",)), Path(sys.executable))
    assert registry.running(FrameMaking) and bpy.ops.plgs.cancel_frames.poll()
    with pytest.raises(RuntimeError, match=worded("at-work")):
        bpy.ops.plgs.import_scene(scene_folder=str(captures / "scans" / "two.sens"))
    plgs.unregister()
    assert registry.latest(FrameMaking) is None
    plgs.register()
