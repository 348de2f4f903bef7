"""A camera of the user's is baked as Blender renders it, frame by frame."""

import math
import shutil
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import OpenEXR
import pytest
from plgs.engine.job import BakeCamera, read_cameras
from plgs.plgs_blender.cameras import panorama_of
from plgs.plgs_blender.shot_names import sequences
from plgs.plgs_blender.shots import Shot, ShotReader, numbered_name, shot_of

from tests.raises_key import raises_key

ENGINES = ("passes.baked_view", "lift.bake_more")


@pytest.fixture
def scene() -> bpy.types.Scene:
    """A camera that looks down at a cube, and dollies and zooms from frame 1 to 4."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_cube_add(size=1.5, location=(0.2, 0.1, 0.3), rotation=(0.3, 0.2, 0.7))
    ob = bpy.data.objects.new("dolly", bpy.data.cameras.new("dolly"))
    scene.collection.objects.link(ob)
    scene.camera = ob
    ob.rotation_euler, ob.scale = (0.5, 0.05, 0.1), (2.0, 2.0, 2.0)
    for frame in (1, 4):
        ob.location = (0.6 + 0.2 * frame, -2.5, 4.5)
        ob.data.lens, ob.data.shift_x = 30.0 + 4.0 * frame, 0.02 * frame
        ob.keyframe_insert("location", frame=frame)
        ob.data.keyframe_insert("lens", frame=frame)
        ob.data.keyframe_insert("shift_x", frame=frame)
    scene.frame_start, scene.frame_end = 1, 4
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 192, 144, 50
    return scene


def cameras_of(scene: bpy.types.Scene, shot: Shot) -> list[BakeCamera]:
    reader = ShotReader(scene, shot)
    assert reader.read_for(math.inf)
    return reader.cameras


def write_shot(lift: Path, scene: bpy.types.Scene, shot: Shot, **given: Any) -> Path:
    reader = ShotReader(scene, shot)
    reader.read_for(math.inf)
    return reader.write(lift, **given)


def rendered_positions(scene: bpy.types.Scene, frame: int, folder: Path) -> np.ndarray:
    """World positions [H, W, 3] that Cycles hits through the middle of each pixel; NaN where it hits nothing."""
    scene.frame_set(frame)
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    cycles.samples, cycles.use_denoising, cycles.use_adaptive_sampling = 1, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 0.01
    scene.view_layers[0].use_pass_position = scene.view_layers[0].use_pass_z = True
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    render.filepath = str(folder / "hits.exr")
    bpy.ops.render.render(write_still=True)
    with OpenEXR.File(render.filepath, separate_channels=True) as file:
        # Blender 5 writes a part a pass.
        found = [(name, each.pixels) for part in file.parts for name, each in part.channels.items()]
        planes = {".".join(name.split(".")[-2:]): pixels for name, pixels in found}
    position = np.stack([planes[f"Position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    position[planes["Depth.V" if "Depth.V" in planes else "Depth.Z"] > 1e6] = np.nan
    return position


def projected(camera: BakeCamera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the engine draws world points [..., 3], by the file's own conventions: pixels [..., 2], depth [...]."""
    pose, ((fx, _, cx), (_, fy, cy), _) = np.array(camera.pinhole.camera_to_world), camera.pinhole.K
    x, y, z = np.moveaxis((points - pose[:3, 3]) @ pose[:3, :3], -1, 0)
    if camera.pinhole.projection == "equirectangular":
        x, y, z = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z)), np.sqrt(x * x + y * y + z * z)
    elif camera.pinhole.projection == "perspective":
        x, y = x / z, y / z
    return np.stack([fx * x + cx, fy * y + cy], axis=-1), z


@pytest.mark.parametrize(
    ("fit", "aspect"),
    [
        ("AUTO", (1.0, 1.0)),
        ("AUTO", (1.0, 1.8)),
        ("HORIZONTAL", (1.5, 1.0)),
        ("VERTICAL", (1.0, 1.0)),
        ("VERTICAL", (1.0, 1.8)),
    ],
)
def test_cameras_of_a_shot_agree_with_blenders_render(
    scene: bpy.types.Scene, fit: str, aspect: tuple[float, float], tmp_path: Path
) -> None:
    data = scene.camera.data
    data.sensor_fit, data.sensor_width, data.sensor_height, data.shift_y = fit, 30.0, 21.0, -0.11
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
    cameras = read_cameras(write_shot(tmp_path, scene, shot_of(scene)))
    assert [camera.name for camera in cameras] == [f"dolly.{frame:04d}" for frame in range(1, 5)]
    position = rendered_positions(scene, 3, tmp_path)
    assert position.shape[:2] == (72, 96) == (cameras[0].pinhole.height, cameras[0].pinhole.width)
    assert_pixels_agree(cameras[2], position)


def assert_pixels_agree(camera: BakeCamera, position: np.ndarray) -> None:
    """The engine draws what Cycles hits where Cycles does."""
    hit = np.isfinite(position[..., 0])
    assert hit.mean() > 0.05
    pixel, depth = projected(camera, position[hit])
    row, column = np.nonzero(hit)
    beside = pixel - np.stack([column + 0.5, row + 0.5], axis=-1)
    if camera.pinhole.projection == "equirectangular":  # round a whole turn
        turn = 2.0 * math.pi * camera.pinhole.K[0][0]
        beside[:, 0] -= np.round(beside[:, 0] / turn) * turn
    assert np.abs(beside).max() < 0.05
    assert (depth > 0).all()


@pytest.mark.parametrize("fit", ["AUTO", "VERTICAL"])
def test_an_orthographic_shot_agrees_with_blenders_render(scene: bpy.types.Scene, fit: str, tmp_path: Path) -> None:
    data = scene.camera.data
    data.type, data.ortho_scale, data.sensor_fit, data.shift_y = "ORTHO", 3.5, fit, -0.07
    scene.render.pixel_aspect_y = 1.4
    cameras = read_cameras(write_shot(tmp_path, scene, shot_of(scene)))
    assert cameras[2].pinhole.projection == "orthographic"
    assert_pixels_agree(cameras[2], rendered_positions(scene, 3, tmp_path))


@pytest.mark.parametrize(("fit", "limits"), [("AUTO", (-180, 180, -90, 90)), ("VERTICAL", (-100, 140, -80, 35))])
def test_an_equirectangular_shot_agrees_with_blenders_render(
    scene: bpy.types.Scene, fit: str, limits: tuple[float, ...], tmp_path: Path
) -> None:
    scene.camera.data.sensor_fit, scene.render.pixel_aspect_y = fit, 1.2
    scene.camera.data.shift_y = 0.0 if limits[3] == 90 else -0.07
    bpy.ops.mesh.primitive_cube_add(size=16.0)  # around the camera
    as_panorama(scene.camera, "EQUIRECTANGULAR", limits)
    cameras = read_cameras(write_shot(tmp_path, scene, shot_of(scene)))
    assert cameras[2].pinhole.projection == "equirectangular"
    assert_pixels_agree(cameras[2], rendered_positions(scene, 3, tmp_path))


def as_panorama(ob: bpy.types.Object, kind: str, limits: tuple[float, ...] = ()) -> None:
    ob.data.type = "PANO"
    settings = panorama_of(ob)
    settings.panorama_type = kind
    for name, degrees in zip(("longitude_min", "longitude_max", "latitude_min", "latitude_max"), limits, strict=False):
        setattr(settings, name, math.radians(degrees))


def test_motion_vectors_of_a_shot_match_those_of_cycles(scene: bpy.types.Scene, tmp_path: Path) -> None:
    scene.camera.data.animation_data_clear()  # Cycles leaves out an animated shift
    scene.view_layers[0].use_pass_vector = True
    cameras = read_cameras(write_shot(tmp_path, scene, shot_of(scene, first=2, last=3, motion=True)))
    # Blender 5.3's own Python lacks the engine's packages.
    passes, bakes = (pytest.importorskip(f"plgs.engine.{name}", exc_type=ImportError) for name in ENGINES)
    view = bakes.view_from(cameras[1])
    assert cameras[1].previous == cameras[0].pinhole and not cameras_of(scene, shot_of(scene))[0].motion
    position = rendered_positions(scene, 3, tmp_path)
    depth = np.nan_to_num(projected(cameras[1], position)[1]).astype(np.float32)
    with OpenEXR.File(str(tmp_path / "hits.exr"), separate_channels=True) as file:
        found = [(name[-8:], each.pixels) for part in file.parts for name, each in part.channels.items()]
    theirs = np.stack([dict(found)[f"Vector.{axis}"] for axis in "XYZW"])
    ours = passes.BakedView(view.camera, SimpleNamespace(depth=depth), (), view.previous, view.following).vectors
    assert (depth > 0).mean() > 0.05 and np.abs(theirs[:, depth > 0]).max() > 1
    assert np.abs(ours - theirs)[:, depth > 0].max() < 0.05


def test_the_render_region_of_a_shot_is_baked(scene: bpy.types.Scene, tmp_path: Path) -> None:
    render = scene.render
    render.use_border, render.use_crop_to_border = True, True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.237, 0.811, 0.129, 0.7
    camera = cameras_of(scene, shot_of(scene))[2]
    position = rendered_positions(scene, 3, tmp_path)
    assert position.shape[:2] == (camera.pinhole.height, camera.pinhole.width) and camera.display is None
    hit = np.isfinite(position[..., 0])
    assert hit.mean() > 0.05
    row, column = np.nonzero(hit)
    assert np.abs(projected(camera, position[hit])[0] - np.stack([column + 0.5, row + 0.5], axis=-1)).max() < 0.05
    render.use_crop_to_border = False
    whole = cameras_of(scene, shot_of(scene))[2]
    assert (whole.pinhole.width, whole.pinhole.height) == (96, 72) and "render region" in shot_of(scene).warnings[0]


def test_overscan_of_a_shot_lies_around_the_display_window(scene: bpy.types.Scene) -> None:
    plain = cameras_of(scene, shot_of(scene))[0]
    scene.eevee.use_overscan, scene.eevee.overscan_size = True, 5.0
    wide = cameras_of(scene, shot_of(scene))[0]
    assert (wide.pinhole.width, wide.pinhole.height, wide.display) == (96 + 10, 72 + 10, (5, 5, 96, 72))
    assert np.array(wide.pinhole.K)[:2, 2] == pytest.approx(np.array(plain.pinhole.K)[:2, 2] + 5)
    assert wide.fingerprint != plain.fingerprint


def test_frames_before_0_of_a_shot_are_baked(scene: bpy.types.Scene, tmp_path: Path) -> None:
    scene.frame_start = 0
    cameras = read_cameras(write_shot(tmp_path, scene, shot_of(scene, first=-2, last=2)))
    assert [camera.name for camera in cameras] == [
        f"dolly.{each}" for each in ("-0002", "-0001", "0000", "0001", "0002")
    ]
    scene.render.filepath = str(tmp_path / "dolly.")
    assert Path(scene.render.frame_path(frame=-2)).stem == cameras[0].name, "as Blender names its own"
    assert [*sequences(["dolly.0002", numbered_name("dolly", -0.25)])] == ["dolly", "dolly.sub750 before 0"]
    scene.frame_end = 12000
    assert cameras_of(scene, shot_of(scene, first=1, last=2))[0].name == "dolly.00001", "as long as the longest"


def test_reading_a_shot_leaves_the_scene_unchanged(scene: bpy.types.Scene) -> None:
    scene.frame_set(3)
    other = bpy.data.objects.new("other", bpy.data.cameras.new("other"))
    scene.timeline_markers.new("cut", frame=2).camera = other
    shown = scene.camera
    cameras = cameras_of(scene, Shot(bpy.data.objects["dolly"], 1, 4, 2))
    assert [camera.name for camera in cameras] == ["dolly.0001", "dolly.0003"]
    assert scene.frame_current == 3 and scene.camera == shown


def test_a_long_shot_is_read_a_few_frames_at_a_time(scene: bpy.types.Scene, tmp_path: Path) -> None:
    scene.frame_set(2)
    reader = ShotReader(scene, shot_of(scene))
    for done in range(1, 5):
        assert reader.read_for(0.0) == (done == 4), "a frame at a time, as there is no time"
        assert reader.progress == (done, 4) and scene.frame_current == 2
    assert read_cameras(reader.write(tmp_path)) == read_cameras(write_shot(tmp_path, scene, shot_of(scene)))
    bpy.data.objects.remove(scene.camera)
    with raises_key("camera-gone"):
        reader.read_for(0.0)


def test_a_keyed_camera_that_rests_all_scene_is_read_once(scene: bpy.types.Scene) -> None:
    """A keyed camera may stand still, which all of the scene's frames decide."""
    for owner in (scene.camera, scene.camera.data):
        owner.animation_data_clear()
    scene.camera.keyframe_insert("location", frame=1)
    scene.frame_end = 9
    reader = ShotReader(scene, shot_of(scene, first=3, last=4))
    said = []
    while not reader.read_for(0.0):
        said.append(reader.progress)
    assert said == [(1, 2), *((number, 9) for number in range(2, 9))]
    assert [camera.name for camera in reader.cameras] == ["dolly.0001"]


def test_a_very_long_scene_range_needs_the_option_range(scene: bpy.types.Scene) -> None:
    scene.frame_end = 2_097_149
    with raises_key("long-range 1048574 --range"):
        shot_of(scene)
    reader = ShotReader(scene, shot_of(scene, only=(1, 2)))
    assert reader.read_for(60.0) and len(reader.cameras) == 2


def test_markers_switch_the_camera_as_in_blender(scene: bpy.types.Scene, tmp_path: Path) -> None:
    far = bpy.data.objects.new("far", bpy.data.cameras.new("far"))
    scene.collection.objects.link(far)
    far.location = (9.0, 0.0, 1.0)
    scene.frame_end = 8
    for frame, camera in ((7, scene.camera), (2, scene.camera), (5, far)):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    shown = {}
    for frame in range(1, 9):
        scene.frame_set(frame)
        shown[frame] = scene.camera.name
    shot = shot_of(scene, motion=True)
    assert {frame: shot.camera_at(frame) for frame in shown} == {**shown, 1: "dolly"}, "before the first marker, too"
    assert any("far from 5" in line and "--camera" in line for line in shot.warnings)
    cameras = cameras_of(scene, shot)
    assert [camera.name for camera in cameras] == [f"cuts.{frame:04d}" for frame in range(1, 9)]
    places = [camera.pinhole.camera_to_world[0][3] for camera in cameras]
    assert [place == 9.0 for place in places] == [False] * 4 + [True] * 2 + [False] * 2
    assert cameras[4].previous is not None and cameras[4].previous.camera_to_world[0][3] == 9.0, "a cut is no motion"
    alone = cameras_of(scene, shot_of(scene, "far", first=5, last=6))
    assert [camera.name for camera in alone] == ["far.0001"], "it stands still"


def test_a_shot_keeps_camera_clipping_and_the_requested_range(scene: bpy.types.Scene) -> None:
    scene.camera.data.clip_start, scene.camera.data.clip_end = 0.25, 40.0
    cameras = cameras_of(scene, shot_of(scene, "dolly", first=2, last=3))
    assert [(camera.name, camera.near, camera.far) for camera in cameras] == [
        ("dolly.0002", 0.25, 40.0), ("dolly.0003", 0.25, 40.0),
    ]  # fmt: skip


def test_a_camera_unfit_for_baking_gives_a_one_line_error(scene: bpy.types.Scene) -> None:
    def refused(line: str, **asked: int) -> None:
        with raises_key(line) as told:
            cameras_of(scene, shot_of(scene, **asked))
        assert "\n" not in str(told.value)

    refused("bad-shot-range", first=5, last=4)
    scene.render.use_border, scene.render.use_crop_to_border, scene.render.border_max_x = True, True, 0.001
    refused("region-empty")
    scene.render.use_border = False
    as_panorama(scene.camera, "FISHEYE_EQUISOLID")
    refused("other-lens panoramic fisheye_equisolid")
    as_panorama(scene.camera, "EQUIRECTANGULAR", (20, -30))
    refused("panorama-limits")
    scene.camera.data.type = "PERSP"
    scene.camera.scale.x = -1.0
    refused("mirrored")
    scene.camera.scale.x = 1.0
    scene.render.resolution_x = 60000
    refused("other-resolution 30000x72")
    scene.camera = None
    refused("no-camera")
    with raises_key("no-camera dolly"):
        shot_of(scene)
    for name in ("nobody", "Cube"):
        with raises_key(f"no-camera '{name}' dolly"):
            shot_of(scene, name)
    scene.camera = bpy.data.objects["Cube"]
    refused("not-a-camera")


def test_all_parts_of_a_shot_name_a_still_camera_alike(scene: bpy.types.Scene, tmp_path: Path) -> None:
    scene.frame_end = 8
    moving = cameras_of(scene, shot_of(scene, first=5, last=8))
    assert [camera.name for camera in moving] == [f"dolly.{frame:04d}" for frame in range(5, 9)], "it moved before"
    scene.camera.animation_data_clear()
    scene.camera.data.animation_data_clear()
    for first, last in ((1, 4), (5, 8), (7, 7)):
        shot = shot_of(scene, "", first=first, last=last)
        assert [camera.name for camera in cameras_of(scene, shot)] == ["dolly.0001"]


def test_a_still_camera_is_read_once_for_all_frames(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    scene.camera.animation_data_clear()
    scene.camera.data.animation_data_clear()
    scene.frame_end = 1_000_000
    shot = shot_of(scene, first=1, last=1_000_000)
    assert [camera.name for camera in cameras_of(scene, shot)] == ["dolly.0000001"]
    scene.frame_end, scene.camera.parent = 4, bpy.data.objects["Cube"]
    driven = scene.camera.parent.driver_add("location", 0).driver
    driven.expression = "frame"
    assert len(cameras_of(scene, shot_of(scene))) == 4, "what it hangs on moves"


def test_shots_of_two_files_do_not_replace_each_other(scene: bpy.types.Scene, tmp_path: Path) -> None:
    lift, shot = tmp_path / "lift", shot_of(scene, given="pan")
    lift.mkdir()
    for name in ("day", "night"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / f"{name}.blend"))
        assert write_shot(lift, scene, shot_of(scene)).name == f"{name}_dolly.1-4x1.json"
        if name == "day":
            write_shot(lift, scene, shot)
            first = write_shot(lift, scene, shot).read_bytes()  # the same file's again
    for output in (None, tmp_path / "passes"):  # each folder has its own shots
        with nullcontext() if output else raises_key("shot-taken pan dolly day.blend"):
            write_shot(lift, scene, shot, output=output)
    assert write_shot(lift, scene, shot_of(scene, given="n 2")).name == "n 2.1-4x1.json"
    assert [camera.name for camera in cameras_of(scene, shot_of(scene, given="n/2"))][0] == "n_2.0001"
    assert write_shot(lift, scene, shot, replace=True).read_bytes() == first
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "day.blend"))
    for output in (None, tmp_path / "passes"):
        with raises_key("shot-taken night.blend"):
            write_shot(lift, bpy.context.scene, shot_of(bpy.context.scene, given="pan"), output=output)


def test_a_refused_bake_leaves_no_file(scene: bpy.types.Scene, tmp_path: Path) -> None:
    def ended(stage: str, last: int) -> list[str]:
        reader, progress = ShotReader(scene, shot_of(scene, last=last)), SimpleNamespace(stage=stage)
        reader.read_for(math.inf)
        reader.write(tmp_path, output=tmp_path / "new" / "passes")
        reader.withdraw_unbaked(SimpleNamespace(progress=progress, state=None))
        return sorted(path.name for path in tmp_path.rglob("*") if path.is_file())

    assert ended("open", 3) == [] == [*tmp_path.iterdir()]
    scene.camera.data.animation_data_clear()
    begun = ["dolly.1-3x1.json", "dolly.shot.json", "dolly.shot.lock"]
    assert ended("bake", 3) == ended("open", 3) == ended("open", 4) == begun


def test_a_shot_of_another_camera_of_the_file_is_reported(scene: bpy.types.Scene, tmp_path: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "day.blend"))
    write_shot(tmp_path, scene, shot_of(scene, given="pan_v{version}"))
    scene.camera.name = "wide"
    with raises_key("shot-taken camera file dolly --replace"):
        write_shot(tmp_path, scene, shot_of(scene, given="pan_v{version}"))


def test_shot_names_that_differ_only_in_capitals_are_refused(scene: bpy.types.Scene, tmp_path: Path) -> None:
    write_shot(tmp_path, scene, shot_of(scene, given="cam"))
    with raises_key("shot-taken --shot capitals"):
        write_shot(tmp_path, scene, shot_of(scene, given="CAM"))
    write_shot(tmp_path, scene, shot_of(scene, given="cam"))


@pytest.mark.parametrize("change", ["camera", "lens", "size"])
def test_a_changed_camera_needs_a_new_version_of_the_shot(change: str, scene: bpy.types.Scene, tmp_path: Path) -> None:
    lift = tmp_path / "lift"
    lift.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "night_v003.blend"))
    by_version, fixed = "{shot}_{camera}_{layer}_v{version:03d}.{frame:04d}", "night"
    for given in (by_version, fixed):
        write_shot(lift, scene, shot_of(scene, last=3, given=given))
        write_shot(lift, scene, shot_of(scene, first=2, given=given))  # more of the same
    for fcurve_owner in (scene.camera, scene.camera.data) if change != "size" else ():
        fcurve_owner.animation_data_clear()
    {
        "camera": lambda: setattr(scene.camera, "location", (2.0, -2.0, 4.0)),
        "lens": lambda: setattr(scene.camera.data, "lens", 80.0),
        "size": lambda: setattr(scene.render, "resolution_percentage", 25),
    }[change]()
    with raises_key("shot-changed night"):
        write_shot(lift, scene, shot_of(scene, given=fixed))
    names = [write_shot(lift, scene, shot_of(scene, given=by_version)).name for _ in range(2)]
    assert names == ["night_dolly_passes_v004.1-4x1.json"] * 2  # the second one is the same again
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "night_v004.blend"))  # the same shot of a later file
    assert write_shot(lift, scene, shot_of(scene, given=by_version)).name == names[0]
    assert write_shot(lift, scene, shot_of(scene, given=fixed), replace=True).name == "night.1-4x1.json"
    write_shot(lift, scene, shot_of(scene, given=fixed))


@pytest.mark.parametrize(
    "template",
    [
        "{lens}",
        "{shot",
        "{shot.__class__}",
        "{shot.format}",
        "{shot:>2000000000}",
        "{version:10d}",
        "{version:q}",
        "{version!r}",
        "{shot[0]}",
        "{shot:{version}}",
        "{{shot}}",
        "{frame:04d}_{shot}",
        "{}",
        "}",
    ],
)
def test_an_unknown_field_in_a_shot_name_is_refused(template: str, scene: bpy.types.Scene) -> None:
    with raises_key("bad-template {version:03d}"):
        ShotReader(scene, shot_of(scene, given=template))


def test_long_shot_names_are_shortened_and_stay_different(scene: bpy.types.Scene, tmp_path: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / f"{'night' * 12}.blend"))
    names = set()
    for camera in ("dolly", "d" * 50 + "1", "d" * 50 + "2"):
        scene.camera.name = camera
        shot = shot_of(scene)
        names.add(write_shot(tmp_path, scene, shot).name)
        assert len(shot.named()) <= 81 and shot.named() in shot.warnings[-1]
    assert len(names) == 3


def test_a_shot_name_given_by_the_user_is_never_shortened(scene: bpy.types.Scene, tmp_path: Path) -> None:
    longest = "n" * 75 + "_v{version:03d}"
    assert Shot(scene.camera, 1, 1, given=longest).named() == "n" * 75 + "_v001"
    with raises_key("long-name --shot"):
        ShotReader(scene, shot_of(scene, given="n" + longest))


def test_a_moved_lift_keeps_the_shots_of_its_blend_file(scene: bpy.types.Scene, tmp_path: Path) -> None:
    for place in ("here", "there"):
        (tmp_path / place / "bake").mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "here" / "lift.blend"))
    write_shot(tmp_path / "here", scene, shot_of(scene))
    shutil.copytree(tmp_path / "here", tmp_path / "there", dirs_exist_ok=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "there" / "lift.blend"))
    write_shot(tmp_path / "there", bpy.context.scene, shot_of(bpy.context.scene))
