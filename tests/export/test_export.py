"""Every export of a small lift, read back by another reader where there is one."""

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.command_line.main import EXPORTS, main
from engine.errors import Cancelled
from engine.export import mesh
from engine.export.run import KINDS, export
from engine.export.source import FinishedLift
from engine.job import LiftFolder
from engine.job.system import MainMemory
from engine.result_files import SemanticPoints, read_arrays
from tests.conftest import HAS_BLENDER
from tests.export.conftest import run
from tests.raises_key import raises_key, worded

Truth = dict[str, tuple[np.ndarray, np.ndarray]]


def test_engine_export_offers_every_format() -> None:
    assert tuple(KINDS) == EXPORTS


def test_depth_clouds_hold_a_point_for_each_pixel(lift: LiftFolder, truth: Truth, tmp_path: Path) -> None:
    run(lift, "clouds", tmp_path, "--frames", "test")
    (path,) = tmp_path.glob("*.npz")
    points = read_arrays(path, SemanticPoints)
    frame, layers = next(iter(FinishedLift(lift, ["test"]).views()))
    semantic, instance = truth[path.stem]
    pixel, depth = frame.camera.project(points.xyz)
    column, row = np.floor(pixel).astype(int).T
    assert path.stem == frame.name and len(points.xyz) == ((layers.combined[..., 3] >= 0.5) & (layers.depth > 0)).sum()
    assert (points.class_id == semantic[row, column]).all() and (points.instance_id == instance[row, column]).all()
    assert np.allclose(depth, layers.depth[row, column], atol=1e-4)


def test_layers_drawn_alone_equal_those_of_a_full_bake(lift: LiftFolder) -> None:
    baker = FinishedLift(lift, ["test"])._baker
    camera = FinishedLift(lift, ["test"]).frames[0].camera
    whole = baker.render(camera).layers
    for wanted in (("combined", "depth"), ("semantic", "instance")):
        drawn = baker.layers(camera, wanted=wanted)
        assert all((getattr(drawn, name) == getattr(whole, name)).all() for name in wanted)


def test_point_clouds_are_exported_for_any_camera(lift: LiftFolder, tmp_path: Path) -> None:
    frame, layers = next(iter(FinishedLift(lift, ["test"]).views()))
    (width, height), pose = frame.size, frame.camera.camera_to_world
    entry = {"name": "shot.0007", "width": width // 2, "height": height // 2, "camera_to_world": pose.tolist()}
    entry |= {"K": frame.camera.resized(width // 2, height // 2).K.tolist(), "clip": [0.1, 3.0]}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    run(lift, "clouds", tmp_path / "out", "--cameras", str(tmp_path / "cameras.json"))
    assert [path.name for path in (tmp_path / "out").glob("*.npz")] == ["shot.0007.npz"]
    points = read_arrays(tmp_path / "out" / "shot.0007.npz", SemanticPoints)
    pixel, depth = frame.camera.project(points.xyz)
    column, row = np.floor(pixel).astype(int).T
    near = (layers.depth > 0) & (layers.depth < 2.9)
    assert 0 < len(points.xyz) <= width * height // 4 and len(points.xyz) > 0.2 * near.sum() and depth.max() < 3.2
    assert (points.class_id == layers.semantic[row, column]).mean() > 0.9
    common = ["export", str(lift.path), "--cameras", str(tmp_path / "cameras.json"), "-o", str(tmp_path / "other")]
    assert main([*common, "--to", "coco"]) == 2 and not (tmp_path / "other").exists()


def test_exported_coco_masks_hold_the_drawn_ids(lift: LiftFolder, truth: Truth, tmp_path: Path) -> None:
    run(lift, "coco", tmp_path)
    content = json.loads((tmp_path / "panoptic.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    categories = {category["id"]: category for category in content["categories"]}
    assert len(images) == len(truth) == 6
    mask = pytest.importorskip("pycocotools.mask")
    names = FinishedLift(lift, ["all"]).instances.names
    cameras = {frame.name: frame.camera for frame in FinishedLift(lift, ["all"]).frames}
    for image in images.values():
        camera = cameras[Path(image["file_name"]).stem]
        np.testing.assert_allclose(image["K"], camera.K)
        np.testing.assert_allclose(image["camera_to_world"], camera.camera_to_world)
    for annotation in content["annotations"]:
        image = images[annotation["image_id"]]
        bgr = cv2.imread(str(tmp_path / "panoptic" / annotation["file_name"])).astype(np.int64)
        ids = bgr[..., 2] + 256 * bgr[..., 1] + 65536 * bgr[..., 0]
        assert ids.shape == (image["height"], image["width"])
        semantic, instance = truth[Path(image["file_name"]).stem]
        shown = {(int(c), int(i)) for c, i in zip(semantic.ravel(), instance.ravel(), strict=True) if c}
        assert len(annotation["segments_info"]) == len(shown)
        for segment in annotation["segments_info"]:
            encoded = mask.encode(np.asfortranarray(ids == segment["id"], np.uint8))
            assert mask.area(encoded) == segment["area"] > 0
            assert mask.toBbox(encoded).tolist() == segment["bbox"]
            pixels = ids == segment["id"]
            assert set(semantic[pixels].tolist()) == {segment["category_id"]}
            assert set(instance[pixels].tolist()) == {segment["instance_id"]}
            of_class = categories[segment["category_id"]]["name"]
            assert segment["name"] == names.get(segment["instance_id"], of_class)
            assert categories[segment["category_id"]]["isthing"] or not instance[pixels].any()
    photos = {frame.colour_path.name for frame in FinishedLift(lift, ["all"]).frames}
    assert {image["file_name"] for image in images.values()} == photos
    coco = pytest.importorskip("pycocotools.coco").COCO(str(tmp_path / "instances.json"))
    coco.info()  # pycocotools 2.0.10 needs the block
    assert {image["file_name"] for image in coco.loadImgs(coco.getImgIds())} == photos
    found = json.loads((tmp_path / "instances.json").read_text())["annotations"]
    assert len(found) == sum(len(np.unique(instance[instance > 0])) for _, instance in truth.values())
    for one in found:
        instance = truth[Path(images[one["image_id"]]["file_name"]).stem][1]
        assert np.array_equal(mask.decode(one["segmentation"]) > 0, instance == one["instance_id"])


def test_exported_label_images_hold_the_drawn_ids(lift: LiftFolder, truth: Truth, tmp_path: Path) -> None:
    run(lift, "instances", tmp_path)
    for name, (semantic, instance) in truth.items():
        for folder, ids in (("class", semantic), ("instance", instance)):
            image = cv2.imread(str(tmp_path / folder / f"{name}.png"), cv2.IMREAD_UNCHANGED)
            assert image.dtype == np.uint16 and (image == ids).all()
            assert cv2.imread(str(tmp_path / f"{folder}_colour" / f"{name}.png")).shape == (*ids.shape, 3)
    labels = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    shown = {int(i) for _, instance in truth.values() for i in np.unique(instance)} - {0}
    assert shown <= {one["id"] for one in labels["instances"]}
    assert {one["class_id"] for one in labels["instances"]} <= {one["id"] for one in labels["classes"]}


def test_a_scannet_export_holds_drawn_ids_and_class_names(lift: LiftFolder, truth: Truth, tmp_path: Path) -> None:
    run(lift, "scannet", tmp_path, "--frames", "0001", "test")
    assert {path.stem for path in (tmp_path / "label-filt").iterdir()} == {"0001", "0004"}
    for folder, which in (("label-filt", 0), ("instance-filt", 1)):
        image = cv2.imread(str(tmp_path / folder / "0001.png"), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint16 and (image == truth["0001"][which]).all()
    rows = [line.split("\t") for line in (tmp_path / "labels.tsv").read_text(encoding="utf-8").splitlines()]
    assert rows[0] == ["id", "raw_category", "category"] and ["5", "chair", "chair"] in rows


def test_open3d_reads_exported_points(lift: LiftFolder, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    run(lift, "points", tmp_path)
    with np.load(lift.result_path / "semantic_points.npz") as points:
        cloud = open3d.t.io.read_point_cloud(str(tmp_path / "points.ply")).point
        np.testing.assert_array_equal(cloud.positions.numpy(), points["xyz"])
        np.testing.assert_array_equal(cloud.colors.numpy(), points["rgb"])
        for name in ("class_id", "instance_id", "confidence"):
            np.testing.assert_array_equal(cloud[name].numpy()[:, 0], points[name])
    normals = cloud.normals.numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3)
    floor = cloud.positions.numpy()[:, 2] < 0.02
    assert floor.any() and np.median(normals[floor, 2]) > 0.9  # up, towards the cameras


def test_exported_boxes_equal_those_of_the_lifts_objects(lift: LiftFolder, tmp_path: Path) -> None:
    run(lift, "boxes", tmp_path)
    records = json.loads((lift.result_path / "instances.json").read_text())["instances"]
    boxes = json.loads((tmp_path / "boxes.json").read_text())["boxes"]
    with (tmp_path / "boxes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(records) == len(boxes) == len(rows) > 0
    for record, box, row in zip(records, boxes, rows, strict=True):
        assert box["size"] == record["size"] and box["name"] == row["name"] == record["name"]
        assert [float(row[f"centre_{axis}"]) for axis in "xyz"] == record["centre"]


def test_splats_are_exported_and_chosen_by_name(lift: LiftFolder, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    run(lift, "splats", tmp_path / "all")
    assert (tmp_path / "all/splats.ply").read_bytes() == (lift.result_path / "gaussians.ply").read_bytes()
    labels = json.loads((tmp_path / "all/labels.json").read_text())
    chair = next(one for one in labels["instances"] if one["name"].startswith("chair"))
    floor = next(one for one in labels["classes"] if one["name"] == "floor")
    run(lift, "splats", tmp_path / "some", "--objects", chair["name"].upper(), "floor")
    whole, some = (open3d.t.io.read_point_cloud(str(tmp_path / each / "splats.ply")).point for each in ("all", "some"))
    kept = (whole["instance_id"].numpy() == chair["id"]) | (whole["class_id"].numpy() == floor["id"])
    np.testing.assert_array_equal(some.positions.numpy(), whole.positions.numpy()[kept[:, 0]])
    np.testing.assert_array_equal(some["f_dc"].numpy(), whole["f_dc"].numpy()[kept[:, 0]])
    assert 0 < kept.sum() < len(kept)


def test_all_objects_of_one_name_are_exported(lift: LiftFolder, tmp_path: Path) -> None:
    """The last of them alone was."""
    own = LiftFolder.open(shutil.copytree(lift.path, tmp_path / "lift"))
    ids = [one.id for one in FinishedLift(own, ["all"]).listed]
    for number in ids:
        assert main(["correct", str(own.path), "rename", str(number), "Seat"]) == 0
    assert len(ids) > 1 and [one.id for one in FinishedLift(own, ["all"], objects=["seat"]).listed] == ids


def test_unknown_objects_are_not_exported(lift: LiftFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["export", str(lift.path), "-o", str(tmp_path / "out"), "--objects"]
    assert main([*common, "throne", "--to", "splats"]) == 2 and main([*common, "floor", "--to", "coco"]) == 2
    told = capsys.readouterr().err
    assert 'nothing called "throne"' in told and "coco cannot be limited" in told and not (tmp_path / "out").exists()


def test_exported_depth_maps_are_finite_floats(lift: LiftFolder, tmp_path: Path) -> None:
    run(lift, "depth", tmp_path)
    for path in sorted(tmp_path.glob("*.npy")):
        depth = np.load(path)
        assert depth.dtype == np.float32 and (depth > 0).any() and np.isfinite(depth).all()
    assert len(list(tmp_path.glob("*.npy"))) > 1


def test_exported_meshes_have_the_labels_and_colours_of_the_room(lift: LiftFolder, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    run(lift, "mesh", tmp_path)
    surface = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    vertices = open3d.t.io.read_point_cloud(str(tmp_path / "mesh.ply")).point  # which knows the labels, too
    xyz, labels = vertices.positions.numpy(), vertices["class_id"].numpy()[:, 0]
    np.testing.assert_allclose(np.asarray(surface.vertices), xyz)
    assert len(surface.triangles) > 1000 and set(np.unique(labels)) <= {0, 1, 2, 3, 5, 13}
    if HAS_BLENDER:
        from plgs.engine.posed.ply import read_surface

        shown = read_surface(tmp_path / "mesh.ply")
        np.testing.assert_array_equal(shown.xyz, xyz)
        np.testing.assert_array_equal(shown.class_id, labels)
        np.testing.assert_array_equal(shown.triangles, np.asarray(surface.triangles))
        assert len(shown.parts()) == len(list((tmp_path / "meshes").iterdir()))
    floor = xyz[labels == 2]
    assert len(floor) > 100 and abs(np.median(floor[:, 2])) < 0.1  # metres
    names = {path.stem for path in (tmp_path / "meshes").iterdir()}
    assert "floor" in names and any(name.startswith("chair") for name in names)
    read = open3d.io.read_triangle_mesh(str(tmp_path / "meshes" / "floor.glb"))
    assert len(read.triangles) > 100 and abs(np.median(np.asarray(read.vertices)[:, 1])) < 0.1  # y is up in glTF
    assert np.median(np.asarray(read.vertex_normals)[:, 1]) > 0.8
    assert np.asarray(read.textures[0]).max() > 100


def test_exporting_again_deletes_meshes_of_deleted_objects(lift: LiftFolder, tmp_path: Path) -> None:
    own = LiftFolder.open(shutil.copytree(lift.path, tmp_path / "lift"))
    meshes = tmp_path / "out" / "meshes"
    run(own, "mesh", tmp_path / "out")
    before = {path.name for path in meshes.iterdir()}
    (meshes / "mine.glb").write_bytes(b"glTF of somebody else")
    chair = next(one for one in FinishedLift(own, ["all"]).listed if one.class_name == "chair")
    assert main(["correct", str(own.path), "delete", str(chair.id)]) == 0
    run(own, "mesh", tmp_path / "out")
    assert {path.name for path in meshes.iterdir()} == before - {f"{chair.name}.glb"} | {"mine.glb"}


@pytest.mark.parametrize("setting", ["mesh.LEAST_ALPHA", "mending.FLAKE"])
@pytest.mark.parametrize("kind", ["mesh", "gltf", "usd", "surface"])
def test_exporting_meshes_of_a_lift_without_surface_is_refused(
    lift: LiftFolder, tmp_path: Path, kind: str, setting: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(f"engine.export.{setting}", 1e6)  # no pixel has depth, or every piece is too small
    assert main(["export", str(lift.path), "--to", kind, "-o", str(tmp_path / "out")]) != 0
    error = capsys.readouterr().err
    assert "show no s" in error and "Export more frames" in error and "Traceback" not in error


def test_an_export_to_a_file_or_of_an_unknown_frame_is_refused(
    lift: LiftFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main(["export", str(lift.path), "--to", "boxes", "-o", str(tmp_path / "file")]) == 2
    assert main(["export", str(lift.path), "--to", "coco", "-o", str(tmp_path), "--frames", "9"]) == 2
    told = capsys.readouterr().err
    assert worded("file-not-folder").search(told) and "no frame 9" in told


def test_an_export_during_which_the_result_changed_is_not_complete(
    lift: LiftFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = LiftFolder.open(shutil.copytree(lift.path, tmp_path / "lift"))

    def adopted(of: object, output: Path) -> None:
        shutil.copytree(own.result_path, tmp_path / "new")
        own.result_path.rename(tmp_path / "old")
        (tmp_path / "new").rename(own.result_path)

    with monkeypatch.context() as other, raises_key("result-changed"):
        other.setitem(KINDS, "boxes", adopted)
        export(own, "boxes", tmp_path / "out", ["test"])
    export(own, "boxes", tmp_path / "out", ["test"])
    assert (tmp_path / "out" / "boxes.csv").is_file()


def test_exports_overwrite_no_other_file(lift: LiftFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    masks = lift.request.scene / "panoptic.json"
    before = masks.read_bytes()
    assert main(["export", str(lift.path), "--to", "coco", "-o", str(lift.request.scene)]) == 2
    assert masks.read_bytes() == before
    assert main(["export", str(lift.path), "--to", "points", "-o", str(lift.result_path)]) == 2
    run(lift, "boxes", tmp_path / "out")
    run(lift, "boxes", tmp_path / "out")  # the same again
    assert main(["export", str(lift.path), "--to", "coco", "-o", str(tmp_path / "out")]) == 2
    assert [bool(worded("folder-used").search(line)) for line in capsys.readouterr().err.splitlines()] == 3 * [True]


@pytest.mark.parametrize("kind", EXPORTS)
def test_an_export_of_an_unknown_frame_is_refused(
    kind: str, lift: LiftFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where all of the lift is exported, whatever frames are named."""
    output = tmp_path / "out"
    assert main(["export", str(lift.path), "--to", kind, "-o", str(output), "--frames", "0001", "nosuch"]) == 2
    said = capsys.readouterr().err
    assert "no frame nosuch" in said and said.count("\n") == 1 and not output.exists()


@pytest.mark.parametrize("form", ["mesh", "gltf", "surface"])
def test_an_export_of_meshes_can_be_stopped_in_each_of_its_steps(lift: LiftFolder, form: str, tmp_path: Path) -> None:
    """Drawing the views is a third of its bar; what follows has shares too, and ends where it is asked to."""
    shares: list[float] = []
    export(lift, form, tmp_path / "whole", ["all"], progress=lambda done, total: shares.append(done / total))
    after_drawing = {round(20 * share) for share in shares if share > 0.35}
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(after_drawing) >= 8

    for asked in (0.2, 0.4, 0.6, 0.8):

        def stop(done: int, total: int, asked: float = asked) -> None:
            if done >= asked * total:
                raise Cancelled("asked to")

        with pytest.raises(Cancelled):
            export(lift, form, tmp_path / f"{asked}", ["all"], progress=stop)
        assert not any(path.suffix in (".glb", ".ply") for path in (tmp_path / f"{asked}").rglob("*"))


def test_an_export_that_needs_more_memory_than_is_free_says_so(
    lift: LiftFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    for free, expected in ((10**10, 0), (10**9, 1)):
        monkeypatch.setattr(mesh, "main_memory", lambda free=free: MainMemory(10**10, free))
        export(lift, "gltf", tmp_path / f"{free}", ["all"], warn=told.append)
        assert len(told) == expected
    assert "1.5 GB of memory, but only 1.0 GB" in told[0]
