"""What docs/passes.md promises, done as it says on a lift of the tiny room, whose geometry is known exactly."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import bpy
import cv2
import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from mathutils import Matrix
from plgs.plgs_blender.cameras import panorama_of

import engine
from engine.passes.exr import read_exr, read_note
from engine.result_files import INSTANCES, read_instances
from tests.commands import answer_of
from tests.doors.terminal import Terminal
from tests.passes.agreement import coverage_of
from tests.raises_key import worded
from tests.tiny_scene import CATEGORIES, tiny_intrinsics, tiny_pose, trace_view

SIZE = (64, 48)
FRAME = "0004"  # held out of six
HALF = ("R", "G", "B", "A", "PLGS.Combined", "PLGS.Confidence", "PLGS.Entropy", "PLGS.Normal")
CAMERA = ".venv/bin/python run_plgs.py -o LIFT --bake camera --blend shot.blend --camera dolly --range 1-250"
EXPORT = ".venv/bin/python -m engine export LIFT --to FORM -o FOLDER"


@pytest.fixture(scope="module")
def baked(lifted: Path, quick_python: Path, tmp_path_factory: pytest.TempPathFactory) -> Terminal:
    """All frames baked with every layer into the folder `shot`. Only for reading."""
    folder = tmp_path_factory.mktemp("passes") / "clone"
    shutil.copytree(lifted, folder)
    terminal = Terminal.like_a_clone(folder, quick_python)
    printed = ".venv/bin/python -m engine bake LIFT --frames all -o FOLDER"
    terminal.run(printed, LIFT="lifts/demo", FOLDER="shot", more=["--layers", "normal", "position", "vector"])
    return terminal


def planes_of(path: Path) -> dict[str, np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def shot_blend(folder: Path) -> Path:
    """An artist's file: from frame 1 to 3 the camera "dolly" goes into the room."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.frame_end = 80, 45, 3
    scene.camera = dolly = bpy.data.objects.new("dolly", bpy.data.cameras.new("dolly"))
    scene.collection.objects.link(dolly)
    pose = tiny_pose(1, 6)
    for frame in (1, 3):
        pose[:3, 3] += 0.1 * pose[:3, 2]
        dolly.matrix_world = Matrix((pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())  # Blender's axes
        dolly.keyframe_insert("location", frame=frame)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"), copy=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return folder / "shot.blend"


def test_each_frame_is_one_multilayer_exr_of_the_frames_size(baked: Terminal) -> None:
    files = sorted((baked.folder / "shot").glob("*.exr"))
    assert [path.stem for path in files] == [f"{number:04d}" for number in range(6)]
    planes = planes_of(files[0])
    assert {plane.shape for plane in planes.values()} == {SIZE[::-1]}
    exact = [name for name in planes if not name.startswith(HALF)]
    assert len(exact) > 20 and {planes[name].dtype for name in exact} == {np.dtype(np.float32)}
    assert {planes[name].dtype for name in {*planes} - {*exact}} == {np.dtype(np.float16)}
    for channel in "RGBA":
        np.testing.assert_array_equal(planes[channel], planes[f"PLGS.Combined.{channel}"])
    instances = {one.id: one.class_id for one in engine.read_lift(baked.folder / "lifts/demo").instances}
    pairs = np.stack([planes["PLGS.Instance.V"], planes["PLGS.Semantic.V"]], axis=-1).reshape(-1, 2)
    for instance, semantic in np.unique(pairs, axis=0).tolist():
        assert instances[int(instance)] == semantic if instance else semantic in {0, 1, 2, 3, 5, 13}
    truth = trace_view(tiny_pose(0, 6), tiny_intrinsics(SIZE), SIZE).semantic
    right, confidence, entropy = (
        planes["PLGS.Semantic.V"] == truth, planes["PLGS.Confidence.V"], planes["PLGS.Entropy.V"]
    )  # fmt: skip
    assert 0 <= confidence.min() < confidence.max() <= 1 and 0 <= entropy.min() < entropy.max() <= 1
    assert confidence[right].mean() > confidence[~right].mean() and entropy[right].mean() < entropy[~right].mean()


def test_depth_is_metres_along_the_viewing_axis(baked: Terminal) -> None:
    planes = planes_of(baked.folder / "shot" / f"{FRAME}.exr")
    truth = trace_view(tiny_pose(4, 6), tiny_intrinsics(SIZE), SIZE).depth
    depth = planes["PLGS.Depth.V"]
    assert np.median(np.abs(depth - truth)[depth > 0]) < 0.15 < 0.5 * np.median(truth)
    steps = depth * 4096
    assert np.abs(steps - np.round(steps)).max() < 1e-2, "in steps of a quarter of a millimetre, 1/4096 m"


def test_the_position_pass_holds_world_coordinates_of_the_surface(baked: Terminal) -> None:
    planes = planes_of(baked.folder / "shot" / f"{FRAME}.exr")
    camera = next(f.camera for f in engine.read_lift(baked.folder / "lifts/demo").frames if f.name == FRAME)
    position = np.stack([planes[f"PLGS.Position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    rows, columns = np.nonzero(planes["PLGS.Depth.V"] > 0)
    local = (position[rows, columns] - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    pixel = local @ camera.K.T
    np.testing.assert_allclose(pixel[:, 0] / pixel[:, 2], columns + 0.5, atol=0.15)
    np.testing.assert_allclose(local[:, 2], planes["PLGS.Depth.V"][rows, columns], rtol=2e-3)


def test_normals_are_of_length_one_and_face_the_camera(baked: Terminal) -> None:
    planes = planes_of(baked.folder / "shot" / f"{FRAME}.exr")
    normal = np.stack([planes[f"PLGS.Normal.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    shown = np.linalg.norm(normal, axis=-1) > 0
    assert shown.mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(normal[shown], axis=-1), 1.0, atol=0.01)
    position = np.stack([planes[f"PLGS.Position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    camera = next(one.camera for one in engine.read_lift(baked.folder / "lifts/demo").frames if one.name == FRAME)
    assert (((camera.camera_to_world[:3, 3] - position) * normal).sum(axis=-1)[shown] > 0).mean() > 0.99


def test_the_vector_pass_points_to_the_previous_and_the_next_frame(baked: Terminal) -> None:
    """By the true cameras, y up, as Cycles has them; 0 where the other camera is unknown."""
    planes = planes_of(baked.folder / "shot" / f"{FRAME}.exr")
    frames = {one.name: one.camera for one in engine.read_lift(baked.folder / "lifts/demo").frames}
    rows, columns = np.nonzero(planes["PLGS.Depth.V"] > 0)
    position = np.stack([planes[f"PLGS.Position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    for other, axes, sign in (("0003", "XY", 1), ("0005", "ZW", -1)):
        then, _ = frames[other].project(position[rows, columns])
        moved = sign * np.stack([then[:, 0] - (columns + 0.5), -(then[:, 1] - (rows + 0.5))], axis=-1)
        shown = np.stack([planes[f"PLGS.Vector.{axis}"] for axis in axes], axis=-1)[rows, columns]
        assert np.median(np.abs(moved)) > 1 and np.median(np.abs(shown - moved)) < 0.1
    for unknown, axes, known in (("0000", "XY", "ZW"), ("0005", "ZW", "XY")):
        planes = planes_of(baked.folder / "shot" / f"{unknown}.exr")
        assert not any(planes[f"PLGS.Vector.{axis}"].any() for axis in axes)
        assert all(planes[f"PLGS.Vector.{axis}"].any() for axis in known)


def test_channels_nuke_names_depth_and_motion_as_nuke_does(baked: Terminal, tmp_path: Path) -> None:
    """Motion forward has the opposite sign."""
    printed = ".venv/bin/python -m engine bake LIFT --frames all -o FOLDER".replace("all", FRAME)
    layers = ["--layers", "normal", "vector", "--channels", "nuke"]
    baked.run(printed, LIFT="lifts/demo", FOLDER=tmp_path / "nuke", more=layers)
    nuke, ours = planes_of(tmp_path / "nuke" / f"{FRAME}.exr"), planes_of(baked.folder / "shot" / f"{FRAME}.exr")
    named = {"depth.Z": "Depth.V", "normal.X": "Normal.X", "semantic.V": "Semantic.V", "backward.u": "Vector.X",
             "backward.v": "Vector.Y", "forward.u": "Vector.Z", "forward.v": "Vector.W"}  # fmt: skip
    for name, own in named.items():
        assert nuke[name].any()
        np.testing.assert_array_equal(nuke[name], (-1 if "forward" in name else 1) * ours[f"PLGS.{own}"])
    assert not any("PLGS" in name for name in nuke)


def test_optional_layers_are_added_to_a_baked_file(terminal: Terminal) -> None:
    bake, path = ".venv/bin/python -m engine bake lifts/demo --frames 1-3:2 -o shot", terminal.folder / "shot/0003.exr"
    has = []
    for layers in ((), ("normal",), ("position",)):
        terminal.run(bake, more=["--layers", *layers] if layers else [])
        has.append({name.split(".")[1] for name in planes_of(path) if name.startswith("PLGS.")})
    usual = {"Combined", "Depth", "Semantic", "Instance", "Confidence", "Entropy"}
    assert has == [usual, usual | {"Normal"}, usual | {"Normal", "Position"}]
    assert sorted(each.stem for each in path.parent.glob("*.exr")) == ["0001", "0003"], "every second of 1 to 3"


def test_a_pixels_id_is_the_object_whose_matte_is_above_one_half(baked: Terminal) -> None:
    lift = engine.read_lift(baked.folder / "lifts/demo")
    for path in sorted((baked.folder / "shot").glob("*.exr")):
        planes = planes_of(path)
        for one in lift.instances:
            matte = coverage_of(planes, "CryptoInstance", one.name)
            whole = planes["A"] > 0.999
            np.testing.assert_array_equal(
                (planes["PLGS.Instance.V"] == one.id)[whole], (matte > 0.5)[whole], err_msg=f"{path.stem} {one.name}"
            )


def test_opencv_and_openimageio_read_the_picture(baked: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    path = baked.folder / "shot" / f"{FRAME}.exr"
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
    planes, picture = planes_of(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(picture[..., 2], planes["R"], rtol=1e-3)
    file = OpenImageIO.ImageInput.open(str(path))
    assert file.spec().channelnames[:4] == ("R", "G", "B", "A")
    file.close()


def test_baking_again_keeps_frames_that_are_baked_already(terminal: Terminal) -> None:
    bake = ".venv/bin/python -m engine bake LIFT --frames all -o FOLDER"
    terminal.run(bake.replace("all", "0001"), LIFT="lifts/demo", FOLDER="shot")
    before = (terminal.folder / "shot" / "0001.exr").stat().st_mtime_ns
    terminal.run(bake.replace("all", "0001 0002"), LIFT="lifts/demo", FOLDER="shot")
    assert (terminal.folder / "shot" / "0001.exr").stat().st_mtime_ns == before
    assert (terminal.folder / "shot" / "0002.exr").is_file()


def test_baking_into_your_own_folder_replaces_only_files_that_plgs_wrote(terminal: Terminal) -> None:
    bake = ".venv/bin/python -m engine bake lifts/demo --frames 0001 -o shot"
    theirs = terminal.folder / "shot" / "0001.exr"
    theirs.parent.mkdir()
    theirs.write_bytes(b"another program's")
    assert "0001.exr" in terminal.run(bake, code=2) and theirs.read_bytes() == b"another program's"
    terminal.run(f"{bake} --replace")
    assert read_exr(theirs).depth.shape == SIZE[::-1]


def test_a_camera_of_your_blend_file_is_baked_under_the_shots_name(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    blend = shot_blend(terminal.folder)
    before = blend.read_bytes()
    printed = CAMERA.replace("1-250", "1-3")
    terminal.run(printed, LIFT="lifts/demo")
    passes = terminal.folder / "lifts/demo/result/passes"
    names = [f"shot_dolly.{frame:04d}.exr" for frame in (1, 2, 3)]
    assert {*names} <= {path.name for path in passes.iterdir()} and blend.read_bytes() == before
    depths = [np.median(read_exr(passes / name).depth) for name in names]
    assert depths[0] > depths[1] > depths[2], "it goes into the room"
    header = OpenEXR.File(str(passes / names[1]), header_only=True).header()
    assert header["imageCounter"] == 2 and header["framesPerSecond"] == 24 and "PLGS" in header["software"]
    assert header["colorInteropID"] == "lin_rec709_scene" and (
        header["pixelAspectRatio"],
        header["timeCode"].frame,
    ) == (1, 2)
    assert {"chromaticities", "screenWindowWidth", "worldToNDC"} <= {*header}
    point = np.append(tiny_pose(1, 6)[:3, :3] @ [0, 0, 1.15] + tiny_pose(1, 6)[:3, 3], 1)  # a metre ahead in frame 2
    np.testing.assert_allclose(point @ header["worldToCamera"], [0, 0, 1, 1], atol=1e-4)
    named = "'{shot}_{camera}_{layer}.{frame:04d}'"
    terminal.run(printed, LIFT="lifts/demo", more=["--passes", "mine", "--shot", named])
    assert {path.name for path in (terminal.folder / "mine").iterdir() if path.suffix} == {
        f"shot_dolly_passes.{frame:04d}.exr" for frame in (1, 2, 3)
    }
    assert (terminal.folder / "mine" / ".plgs").is_dir(), "its notes lie in the hidden folder"


@pytest.fixture
def blend(terminal: Terminal) -> Path:
    return shot_blend(terminal.folder)


def changed(blend: Path, change: Callable[[bpy.types.Scene], object]) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    change(bpy.context.scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(blend), copy=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def baked_names(terminal: Terminal, *more: str) -> list[str]:
    """What is new in the lift after a bake of a camera with these options."""
    passes = terminal.folder / "lifts/demo/result/passes"
    before = {*passes.iterdir()}
    terminal.run(".venv/bin/python run_plgs.py -o lifts/demo --bake camera --blend shot.blend", more=more)
    return sorted(path.name for path in {*passes.iterdir()} - before)


def test_baking_a_blend_uses_its_active_camera_and_range_and_names_subframes(terminal: Terminal, blend: Path) -> None:
    passes = terminal.folder / "lifts/demo/result/passes"
    assert baked_names(terminal) == [f"shot_dolly.{frame:04d}.exr" for frame in (1, 2, 3)]
    between = ["shot_dolly.-0001.exr", "shot_dolly.sub500.0001.exr"]
    assert baked_names(terminal, "--range", "-1,1-2:0.5") == between
    depths = [np.median(read_exr(passes / f"shot_dolly.{each}.exr").depth) for each in ("0001", "sub500.0001", "0002")]
    assert depths[0] > depths[1] > depths[2], "half a frame after frame 1"


def test_a_still_camera_is_baked_once_and_camera_markers_make_one_shot(terminal: Terminal, blend: Path) -> None:
    def cut(scene: bpy.types.Scene) -> None:
        still = bpy.data.objects.new("still", bpy.data.cameras.new("still"))
        scene.collection.objects.link(still)
        still.matrix_world = Matrix((tiny_pose(3, 6) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())
        for frame, camera in ((1, bpy.data.objects["dolly"]), (3, still)):
            scene.timeline_markers.new(camera.name, frame=frame).camera = camera
        scene.render.use_motion_blur = still.data.dof.use_dof = scene.render.use_border = True

    changed(blend, cut)
    assert baked_names(terminal, "--camera", "still", "--range", "1-3") == ["shot_still.0001.exr"]
    assert baked_names(terminal) == [f"shot_cuts.{frame:04d}.exr" for frame in (1, 2, 3)]
    passes = terminal.folder / "lifts/demo/result/passes"
    cuts, still = (planes_of(passes / name)["PLGS.Depth.V"] for name in ("shot_cuts.0003.exr", "shot_still.0001.exr"))
    np.testing.assert_array_equal(cuts, still)
    told = terminal.run(CAMERA.replace("1-250", "1"), LIFT="lifts/demo", more=["--camera", "still", "--shot", "a:b"])
    assert all(word in told for word in ("motion blur", "depth of field", "region")), told
    assert (passes / "a_b.0001.exr").is_file(), "characters that some system refuses become _"
    assert "--shot" in terminal.run(CAMERA, code=2, LIFT="lifts/demo", more=["--shot", "n" * 81])


def test_bake_takes_cameras_of_any_program(terminal: Terminal) -> None:
    K, pose = tiny_intrinsics((80, 60)), tiny_pose(2, 6)
    entry = {"name": "any.0007", "width": 80, "height": 60, "K": K.tolist(), "camera_to_world": pose.tolist()}
    (terminal.folder / "cameras.json").write_text(json.dumps([entry]))
    printed = ".venv/bin/python -m engine bake LIFT --cameras FILE.json"
    terminal.run(printed.replace("FILE.json", "cameras.json"), LIFT="lifts/demo")
    shown = read_exr(terminal.folder / "lifts/demo/result/passes/any.0007.exr")
    truth = trace_view(pose, K, (80, 60))
    assert np.median(np.abs(shown.depth - truth.depth)) < 0.2
    assert (shown.semantic == truth.semantic).mean() > 0.7


def as_kind(scene: bpy.types.Scene, kind: str) -> None:
    camera = bpy.data.objects["dolly"]
    camera.data.type, camera.data.ortho_scale = ("ORTHO" if kind == "orthographic" else "PANO"), 2.0
    if kind != "orthographic":
        panorama_of(camera).panorama_type = kind.upper()


def test_panoramic_cameras_other_than_equirectangular_are_refused(terminal: Terminal, blend: Path) -> None:
    changed(blend, lambda scene: as_kind(scene, "mirrorball"))
    assert worded("other-lens").search(terminal.run(CAMERA, code=2, LIFT="lifts/demo"))


@pytest.mark.parametrize("kind", ["orthographic", "equirectangular"])
def test_orthographic_and_equirectangular_cameras_are_baked_with_all_layers(
    kind: str, terminal: Terminal, blend: Path
) -> None:
    changed(blend, lambda scene: as_kind(scene, kind))
    more = ["--layers", "normal", "position", "vector"]
    terminal.run(CAMERA.replace("1-250", "2"), LIFT="lifts/demo", more=more)
    path = terminal.folder / "lifts/demo/result/passes/shot_dolly.0002.exr"
    planes, shown, note = planes_of(path), read_exr(path), read_note(path, "plgs/projection") or ""
    assert note.startswith(kind) and ("along the ray" in (read_note(path, "plgs/depth") or "")) == (
        kind != "orthographic"
    )
    drawn = shown.depth > 0
    assert drawn.mean() > 0.1 and len(np.unique(shown.semantic)) > 2
    place = np.stack([planes[f"PLGS.Position.{axis}"] for axis in "XYZ"], axis=-1)
    pose = tiny_pose(1, 6)
    local = (place - pose[:3, 3]) @ pose[:3, :3] - [0.0, 0.0, 0.15]
    if kind == "equirectangular":
        far = np.linalg.norm(local, axis=-1)
        right = np.arctan2(local[..., 0], local[..., 2]) * 80 / (2 * np.pi) + 40
    else:
        far, right = local[..., 2], local[..., 0] * 80 / 2.0 + 40
    assert np.abs(far - shown.depth)[drawn].max() < 2e-3
    assert np.abs(right - np.arange(80) - 0.5)[drawn].max() < 0.02
    normal = np.stack([planes[f"PLGS.Normal.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float32)
    assert np.abs(np.linalg.norm(normal[drawn], axis=-1) - 1.0).max() < 2e-3
    assert np.abs(planes["PLGS.Vector.X"]).max() > 0
    for one in np.unique(shown.instance[shown.instance > 0]):
        name = next(
            each.name for each in read_instances(terminal.folder / "lifts/demo/result" / INSTANCES)[1] if each.id == one
        )
        matte = coverage_of(planes, "CryptoInstance", name)
        whole = planes["A"] > 0.99
        assert ((matte > 0.5) == (shown.instance == one))[whole].all()


@pytest.mark.parametrize(("metres", "told"), [(30.0, "no surface"), (-1.0, "no surface"), (1.3, "times as large")])
def test_a_bake_warns_of_surface_that_no_photo_shows_sharply(metres: float, told: str, terminal: Terminal) -> None:
    """From far outside, from behind, and from so near that it is shown over twice as large as in any photo."""
    pose = tiny_pose(0, 6)
    pose[:3, 3] += metres * pose[:3, 2]
    entry = {"name": "any.0001", "width": 256, "height": 192, "K": tiny_intrinsics((256, 192)).tolist()}
    (terminal.folder / "cameras.json").write_text(json.dumps([{**entry, "camera_to_world": pose.tolist()}]))
    said = terminal.run(".venv/bin/python -m engine bake lifts/demo --cameras cameras.json")
    shares = re.search(r"(\d+)% is shown more than 2 times as large as in any photo, (\d+)% has no surface", said)
    assert shares is not None, said
    assert int(shares[1 if "large" in told else 2]) >= 10


def test_the_option_objects_limits_an_export_to_these_objects(terminal: Terminal) -> None:
    chair = next(one for one in engine.read_lift(terminal.folder / "lifts/demo").instances if one.class_name == "chair")
    own = {"LIFT": "lifts/demo", "FORM": "boxes", "FOLDER": "boxes"}
    terminal.run(EXPORT, **own, more=["--objects", '"chair 1"'])
    boxes = json.loads((terminal.folder / "boxes" / "boxes.json").read_text())
    assert [one["name"] for one in boxes["boxes"]] == [chair.name] == ["chair 1"]
    begun, *_, ended = (terminal.folder / "boxes" / ".plgs-written.jsonl").read_text().splitlines()
    assert json.loads(begun)["begins"] == "export" and json.loads(ended) == {"complete": True}


def test_usd_exports_are_in_metres_z_up_with_a_component_for_each_object(terminal: Terminal) -> None:
    pxr = pytest.importorskip("pxr")
    from pxr import Kind, Usd, UsdGeom

    assert pxr
    terminal.run(EXPORT, LIFT="lifts/demo", FORM="usd", FOLDER="usd")
    stage = Usd.Stage.Open(str(terminal.folder / "usd" / "lift.usdc"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    objects = stage.GetPrimAtPath("/Lift/Objects").GetChildren()
    assert {one.GetDisplayName() for one in objects} == {"chair 1", "cabinet 1"}
    assert all(Usd.ModelAPI(one).GetKind() == Kind.Tokens.component for one in objects)


def test_a_lift_and_its_coco_export_score_the_same(terminal: Terminal, capsys: pytest.CaptureFixture[str]) -> None:
    terminal.run(EXPORT, LIFT="lifts/demo", FORM="coco", FOLDER="labels", more=["--frames", "test"])
    made = json.loads((terminal.folder / "labels" / "instances.json").read_text())
    assert "PLGS" in made["info"]["description"]
    assert {each["file_name"] for each in made["images"]} <= {path.name for path in terminal.folder.rglob("color/*")}
    truth = terminal.folder / "scans/room/gt"
    classes = [{"id": each["id"], "name": each["name"], "is_thing": bool(each["isthing"])} for each in CATEGORIES]
    (truth / "labels.json").write_text(json.dumps({"classes": classes}))
    of_lift = answer_of(capsys, "evaluate", terminal.folder / "lifts/demo")["tables"]
    of_export = answer_of(capsys, "evaluate", "--predictions", terminal.folder / "labels", "--truth", truth)["tables"]
    for table in of_export:
        (own,) = (each for each in of_lift if (each["name"], each["mode"]) == ("lifted", table["mode"]))
        assert own["pq"] > 0.3 and all(abs(own[key] - table[key]) < 0.001 for key in ("miou", "miou_true", "pq"))
    assert len(of_export) == 2
