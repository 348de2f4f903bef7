"""What docs/captures.md promises, done as it says on captures as their formats' documentation shows them."""

import json
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from engine import poses
from engine.command_line.main import main
from engine.scene import open_scene
from tests.commands import answer_of
from tests.doors.terminal import ROOT, Terminal
from tests.poses.test_making import aligned
from tests.raises_key import worded
from tests.scene.formats import test_photogrammetry as photogrammetry
from tests.scene.formats import test_seven_scenes as seven_scenes
from tests.scene.formats.room import check_colours, check_on_room, distance_to_room, in_steps, views
from tests.scene.formats.test_arkitscenes import write_video
from tests.scene.formats.test_colmap import binary, write_depth, write_text
from tests.scene.formats.test_hypersim import SHIFTED, USUAL, write_hypersim
from tests.scene.formats.test_nerfstudio import write_scene as write_nerfstudio
from tests.scene.formats.test_phone_apps import write_polycam, write_scanner_app, write_stray
from tests.scene.formats.test_record3d import lzfse, write_exr_rgbd, write_r3d  # noqa: F401
from tests.scene.formats.test_scannet import sens
from tests.scene.formats.test_scannetpp import one_stream, write_scannetpp
from tests.scene.formats.test_tum import write_tum
from tests.tiny_scene import CABINET, CHAIR, ROOM, TinyView, tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene

INSPECT = ".venv/bin/python -m engine inspect SCENE"
FRAMES = ".venv/bin/python -m engine frames SCENE -o FOLDER"
POSES = ".venv/bin/python -m engine poses PHOTOS"


QUICK = ("--steps", "5", "--set", "warm_start=false", "--bake", "none")
SCALE = "scale, which is unknown"


def write_colmap(folder: Path) -> None:
    write_depth(write_text(folder))


def write_sens(folder: Path) -> None:
    (folder / "scene0000_00.sens").write_bytes(sens(lost=2))


LAYOUTS: list[tuple[str, Callable[[Path], object], str, float, float]] = [
    ("7scenes", seven_scenes.write_info, "", 0.06, 60),
    ("record3d", lambda folder: write_r3d(folder / "a.r3d"), "", 0.004, 60),
    ("record3d", lambda folder: write_exr_rgbd(folder / "EXR_RGBD"), "", 0.004, 60),
    ("metashape", lambda folder: photogrammetry.metashape_xml(folder, photogrammetry.NONE, whole=True), SCALE, 0, 0),
    ("reality", lambda folder: photogrammetry.reality_csv(folder, photogrammetry.NONE, views()), SCALE, 0, 0),
    ("colmap", binary, "", 0, 0),
    ("nerfstudio", lambda folder: write_nerfstudio(folder, depth=False), "", 0, 0),
    ("sens", write_sens, "1 frame without a pose is left out: 2", 0.06, 0),
    ("nerfstudio", write_nerfstudio, "", 0.004, 0),
    ("colmap", write_colmap, "", 0.004, 0),
    ("tum", write_tum, "a Kinect's lens is assumed", 0.004, 0),
    ("replica", seven_scenes.write_nice, "", 0.004, 60),
    ("polycam", write_polycam, "", 0.004, 0),
    ("polycam", lambda folder: write_polycam(folder, corrected=False), "not optimised", 0.004, 0),
    ("stray", write_stray, "1 frame without a pose is left out: 000000", 0.004, 60),
    ("stray", lambda folder: write_stray(folder, older=True), "", 0.004, 60),
    ("scanner-app", write_scanner_app, "", 0.004, 60),
    ("scannetpp", lambda folder: write_scannetpp(folder, one_stream), "without a pose is left out", 0.004, 60),
    ("hypersim", lambda folder: write_hypersim(folder / "ai_001_001", USUAL), "", 0.001, 60),
    ("hypersim", lambda folder: write_hypersim(folder / "ai_001_001", SHIFTED), "", 0.001, 60),
    ("arkitscenes", lambda folder: write_video(folder, "wide"), "", 0.004, 0),
    ("arkitscenes", lambda folder: write_video(folder / "40777060_frames", "lowres_wide"), "", 0.004, 0),
]
"""A layout, its writer, what a reader says of it, how far its depth may lie from the room in metres (0: it has none),
and how far a colour from the room's, of 255 (pictures are compressed)."""


@pytest.mark.parametrize(("layout", "write", "said", "away", "colour_step"), LAYOUTS)
def test_the_layout_is_recognised_by_the_files_in_it(
    layout: str, write: Callable[[Path], object], said: str, away: float, colour_step: float, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Or named by --format. Its depth and colours lie on the room, and so does the cloud that is shown of it."""
    place = tmp_path / "scan"
    place.mkdir()
    write(place)
    place = place / "ai_001_001" if layout == "hypersim" else place
    told = answer_of(capsys, "inspect", place)
    assert told["format"] == layout and said in json.dumps(told, ensure_ascii=False)
    scene = open_scene(place, scene_format=layout)
    if not away:
        assert not scene.has_depth
        return check_colours(scene)
    share = 0.97 if layout in ("sens", "7scenes") else 0.99
    check_on_room(scene, tolerance=away, share=share, colour_step=colour_step)
    made = answer_of(capsys, "frames", place, "-o", tmp_path / "out", "--make", "cloud", "--format", layout)
    cloud = np.load(Path(made["folder"]) / "cloud.npz")
    turn, shift = _onto_room(scene)
    near = distance_to_room(cloud["xyz"].astype(np.float64) @ turn.T + shift) < 0.03 + away
    assert len(near) > 500 and near.mean() > 0.97


def _onto_room(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and the shift that take the scene's world to the room's, by where its cameras stand."""
    found = np.array([frame.camera.centre for frame in scene.frames])
    known = np.array([view.eye for view in views(len(found))])
    left, _, right = np.linalg.svd((known - known.mean(0)).T @ (found - found.mean(0)))
    turn = left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right
    return turn, known.mean(0) - turn @ found.mean(0)


@pytest.fixture
def inverted(tmp_path: Path) -> Path:
    """A scan whose program wrote world-to-camera poses."""
    folder = write_tiny_scene(tmp_path / "scan", 14, (96, 72))
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.linalg.inv(np.loadtxt(path)))
    return folder


def test_inspect_says_what_is_in_a_scene_and_what_is_wrong(inverted: Path, shell: Terminal) -> None:
    told = shell.run(INSPECT, SCENE=inverted)
    assert "wrong: inverted poses: " in told and "chair" in told and "14 frames" in told
    assert "inferred  format: the format is scannet: " in told and "untested  drift along " in told


def test_inspect_writes_a_picture_for_each_finding_that_shows_in_one(inverted: Path, shell: Terminal) -> None:
    shell.run(".venv/bin/python -m engine inspect SCENE -o FOLDER", SCENE=inverted, FOLDER="found")
    (finding,) = json.loads((shell.folder / "found/findings.json").read_text())["findings"]
    assert finding["cause"] == "inverted poses" and cv2.imread(str(shell.folder / "found" / finding["picture"])).std()


def test_inspect_writes_a_mended_scene_and_your_files_stay_as_they_are(
    inverted: Path, shell: Terminal, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in inverted.rglob("*") if path.is_file()}
    told = shell.run(".venv/bin/python -m engine inspect SCENE --fix OUT", SCENE=inverted, OUT="mended")
    assert "mended    inverted poses" in told
    assert {path: path.read_bytes() for path in inverted.rglob("*") if path.is_file()} == before
    assert answer_of(capsys, "inspect", shell.folder / "mended")["diagnosis"]["findings"] == []
    for name in ("0000", "0013"):
        pose = np.loadtxt(shell.folder / f"mended/pose/{name}.txt")
        np.testing.assert_allclose(pose, np.linalg.inv(np.loadtxt(inverted / f"pose/{name}.txt")), atol=1e-6)
    assert main(["inspect", str(inverted), "--fix", str(inverted / "depth/mended")]) == 2


def test_inverted_poses_stop_a_lift_and_it_says_what_mends_them(
    inverted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lift", str(inverted), "-o", str(tmp_path / "lift"), "--preset", "preview"]) == 2
    told = capsys.readouterr().err
    assert "inverted poses" in told and "--fix" in told and "--anyway" in told


def test_up_to_half_of_frames_may_lack_depth_mask_or_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tiny_scene(tmp_path / "scan", 8)
    (folder / "pose/0000.txt").write_text("inf " * 16)
    (folder / "depth/0001.png").unlink()
    (folder / "panoptic/0002.png").write_bytes((folder / "panoptic/0002.png").read_bytes()[:40])
    told = answer_of(capsys, "inspect", folder)
    assert told["train_frames"] + told["test_frames"] == 5
    assert all(any(name in warning for warning in told["warnings"]) for name in ("0000", "0001", "0002"))
    for name in ("0003", "0004", "0005", "0006"):
        (folder / f"depth/{name}.png").unlink()
    assert main(["inspect", str(folder)]) == 2 and "depth" in capsys.readouterr().err


def test_depth_poses_and_split_of_a_scannet_folder_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tiny_scene(tmp_path / "scan", 18, (64, 48), depth_size=(32, 24))
    (folder / "pose/0001.txt").write_text("inf " * 16)
    depth = cv2.imread(str(folder / "depth/0000.png"), cv2.IMREAD_UNCHANGED)
    depth[:3], depth[3:6] = 0, 65535
    cv2.imwrite(str(folder / "depth/0000.png"), depth)
    told = answer_of(capsys, "inspect", folder)
    assert (told["train_frames"], told["test_frames"], told["depth_sizes"]) == (15, 2, [[[32, 24], 17]])
    assert told["depth_range"][2] < 5 and any("0001" in each for each in told["warnings"])
    assert told["extent"] == pytest.approx(np.ptp([tiny_pose(k, 18)[:3, 3] for k in range(18) if k != 1], axis=0))
    (folder / "splits.json").write_text('{"train": ["0002", "0003"], "test": ["0004"]}')
    told = answer_of(capsys, "inspect", folder)
    assert (told["train_frames"], told["test_frames"]) == (2, 1)


def test_without_a_split_at_most_40_frames_are_held_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = answer_of(capsys, "inspect", write_tiny_scene(tmp_path, 330, (16, 12), masks="none", ground_truth=False))
    assert told["train_frames"] + told["test_frames"] == 330 and 30 < told["test_frames"] <= 40


def test_ground_truth_may_be_smaller_lack_frames_and_use_another_class_table(
    lifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the metrics read it, and they stay as they were."""
    shutil.copytree(lifted, tmp_path, dirs_exist_ok=True)
    lift, truth = tmp_path / "lifts/demo", tmp_path / "scans/room/gt"

    def scores() -> list[tuple[float, float]]:
        tables = answer_of(capsys, "evaluate", lift)["tables"]
        return [(each["miou_true"], each["pq"]) for each in tables if each["name"] == "lifted"]

    def renumber(was: int, now: int) -> None:
        for path in (truth / "semantic_nyu40").iterdir():
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.where(pixels == was, now, pixels).astype(np.uint8))

    assert main(["find-scene", str(lift), str(tmp_path / "scans/room")]) == 0
    assert main(["correct", str(lift), "rename", "1", "seat"]) == 0  # else evaluate repeats metrics.json
    before = scores()
    for path in truth.rglob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[1::2, 1::2])
    (truth / "semantic").rename(truth / "semantic_nyu40")
    renumber(13, 22)  # a ceiling
    for own, now in zip(scores(), before, strict=True):
        assert own == pytest.approx(now, abs=0.02)
    renumber(3, 7)  # a table, which the masks do not know
    assert scores()[0][1] < before[0][1] - 0.1
    told = answer_of(capsys, "inspect", tmp_path / "scans/room")
    assert told["ground_truth_frames"] == 6 and any("classes table of the ground" in each for each in told["warnings"])
    (truth / "instance/0004.png").unlink()  # of the only frame that is held out
    assert scores() == [(None, None)], "frames without it are not scored"


def write_room_mesh(path: Path) -> None:
    """The tiny room as OBJ, whose surfaces face the cameras."""
    lines: list[str] = []
    for number, box in enumerate((ROOM, CHAIR, CABINET)):
        corners = np.array([[box[k >> axis & 1, axis] for axis in range(3)] for k in range(8)])
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        for axis in range(3):
            for side in range(2):
                a, b, c, d = (k for k in range(8) if k >> axis & 1 == side)
                for triangle in ([a, b, c], [b, d, c]):
                    p, q, r = corners[triangle]
                    inward = np.cross(q - p, r - p) @ (p - box.mean(0)) < 0
                    ordered = triangle if inward == (number == 0) else triangle[::-1]
                    lines.append("f " + " ".join(str(8 * number + k + 1) for k in ordered))
    path.write_text("\n".join(lines) + "\n")


def test_depth_from_a_mesh_is_the_true_depth_of_the_room(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A frame that contradicts the mesh is left out."""
    size = (160, 120)

    def true_view(number: int) -> TinyView:
        return trace_view(tiny_pose(number, 8), tiny_intrinsics(size), size)

    folder = write_tiny_scene(tmp_path / "scan", 8, size)
    shutil.rmtree(folder / "depth")
    write_room_mesh(tmp_path / "room.obj")
    path, mirrored = folder / "color/0007.png", folder / "color/0003.png"
    cv2.imwrite(str(mirrored), cv2.imread(str(mirrored))[::-1])
    left, top, width, height = cv2.boundingRect((true_view(7).instance == 1).astype(np.uint8))
    painted = slice(top - 9, top + height + 9), slice(left + width // 2, left + width + 9)
    picture = cv2.imread(str(path))
    picture[painted] = 90
    cv2.imwrite(str(path), picture)
    told = answer_of(capsys, "inspect", folder, "--depth", tmp_path / "room.obj")
    assert "1 frame without the mesh's outlines in its photo is left out: 0003" in told["warnings"]
    for frame in open_scene(folder, depth=tmp_path / "room.obj").frames:
        truth, depth = true_view(int(frame.name)), frame.depth(None)
        np.testing.assert_allclose(depth[depth > 0], truth.depth[depth > 0], atol=1e-4)
        assert (depth > 0).mean() > 0.9
        if frame.name == "0007":
            outline = cv2.morphologyEx((truth.instance == 1).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3)))
            assert (depth[painted] > 0)[outline[painted] > 0].mean() < 0.5
            outline[painted] = 0
            assert (depth > 0)[outline > 0].mean() > 0.7
    out = tmp_path / "lift"
    command = ["lift", str(folder), "--depth", str(tmp_path / "room.obj"), "-o", str(out), "--size", "64x48"]
    assert main([*command, *QUICK]) == 0
    assert "the format is scannet" in (out / "log.txt").read_text(), "what no file says is inferred, and told there"
    assert json.loads((out / "request.json").read_text())["depth"] and (out / "result/manifest.json").is_file()


@pytest.mark.slow
def test_a_batch_reports_a_faulty_scene_and_lifts_it_if_its_row_says_anyway(inverted: Path, shell: Terminal) -> None:
    pytest.importorskip("distributed")
    (shell.folder / "scans.csv").write_text(f"scene,name,anyway\n{inverted},kept,\n")
    batch = ".venv/bin/python -m engine batch --scenes scans.csv -o OUT --workers 1 --steps 5 --set warm_start=false"
    shell.run(batch, code=2, OUT="out")
    assert "inverted poses" in (shell.folder / "out/table.csv").read_text()
    (shell.folder / "scans.csv").write_text(f"scene,name,anyway\n{inverted},kept,true\n")
    shell.run(batch, OUT="out")
    assert "kept,done" in (shell.folder / "out/table.csv").read_text()


def test_frames_writes_undistorted_pictures_and_masks_in_their_classes_colours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_nerfstudio(tmp_path / "bent", k1=-0.1)
    made = Path(answer_of(capsys, "frames", tmp_path / "bent", "-o", tmp_path / "straight")["folder"])
    frames = {frame.name: frame for frame in open_scene(tmp_path / "bent").frames}
    written = sorted((made / "color").iterdir())
    assert [path.stem for path in written] == sorted(frames)
    for path in written:
        straight = frames[path.stem].read_colour(None)[..., ::-1].astype(int)
        assert np.abs(cv2.imread(str(path)).astype(int) - straight).mean() < 5
    folder = write_tiny_scene(tmp_path / "room", 2)
    made = Path(answer_of(capsys, "frames", folder, "-o", tmp_path / "out")["folder"])
    classes = open_scene(folder).classes
    truth = trace_view(tiny_pose(0, 2), tiny_intrinsics((64, 48)), (64, 48)).semantic
    drawn = cv2.imread(str(made / "masks/0000.png"))[..., ::-1]
    assert not (made / "color").exists(), "they are files already"
    for number in np.unique(truth):
        found, count = np.unique(drawn[truth == number], axis=0, return_counts=True)
        assert tuple(found[count.argmax()]) == tuple(classes[int(number)].colour)


def test_frames_extracts_pictures_of_a_video_and_needs_no_masks(tmp_path: Path, shell: Terminal) -> None:
    """Those of Stray Scanner's video, with depth in colours and a cloud."""
    write_stray(tmp_path / "scan")
    assert "6 frames in" in shell.run(FRAMES, SCENE=tmp_path / "scan", FOLDER="plain")
    names = [f"{number:06d}" for number in range(2, 8)]
    for folder, suffix in (("color", "jpg"), ("depth", "png")):
        assert sorted(path.name for path in (shell.folder / "plain" / folder).iterdir()) == [
            f"{name}.{suffix}" for name in names
        ]
    film = cv2.VideoCapture(str(tmp_path / "scan/rgb.mp4"))
    film.set(cv2.CAP_PROP_POS_FRAMES, 2)
    shown = cv2.imread(str(shell.folder / "plain/color/000002.jpg")).astype(int)
    assert np.abs(shown - film.read()[1]).mean() < 5
    depth = cv2.imread(str(shell.folder / "plain/depth/000002.png"))
    assert depth.std(axis=(0, 1)).min() > 10 and len(np.load(shell.folder / "plain/cloud.npz")["rgb"]) > 500


def test_a_finished_3d_model_is_refused_with_advice_which_export_to_choose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "Scaniverse 2026-01-02.spz").write_bytes(b"")
    assert main(["inspect", str(tmp_path)]) == 2
    assert worded("models-only").search(capsys.readouterr().err)


METADATA = '{"intrinsicMatrix": [1], "rangeOfEncodedDepth": [0.5, 4.5]}'


def write_rgbd_video(path: Path, pictures: list[np.ndarray], depths: list[np.ndarray], metadata: str) -> None:
    """Record3D's "RGBD video": the hue of the left half says the depth of the right one, black says none. The range is
    in the metadata at the end of the file (https://github.com/marek-simonik/record3d)."""
    height, width = depths[0].shape
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (2 * width, height))
    for picture, depth in zip(pictures, depths, strict=True):
        hue = np.round(256 * (np.clip(depth, 0.5, 4.45) - 0.5) / 4).astype(np.uint8)
        full = np.full_like(hue, 255)
        left = cv2.cvtColor(np.stack([hue, full, full], -1), cv2.COLOR_HSV2BGR_FULL)
        left[depth == 0] = 0
        film.write(np.concatenate([left, picture], axis=1))
    film.release()
    path.write_bytes(path.read_bytes() + (8 + len(metadata)).to_bytes(4, "big") + b"free" + metadata.encode())


class _Found:
    """What COLMAP finds: a camera at the origin, whose points have half of their depth in metres."""

    def __init__(self, photos: Path, depth: np.ndarray) -> None:
        height, width = depth.shape
        rows, columns = np.mgrid[12:height:4, 2:width:4].reshape(2, -1)
        xy = np.stack([columns + 0.5, rows + 0.5], -1)
        z = depth[rows, columns] / 2
        self.points3D = {k: SimpleNamespace(xyz=np.array([0, 0, each])) for k, each in enumerate(z)}
        seen = [SimpleNamespace(xy=each, point3D_id=k, has_point3D=lambda: True) for k, each in enumerate(xy)]
        pose = SimpleNamespace(matrix=lambda: np.eye(3, 4))
        names = [path.name for path in photos.iterdir() if path.suffix == ".jpg"]
        image = {"camera_id": 1, "has_pose": True, "points2D": seen, "cam_from_world": lambda: pose}
        self.images = {name: SimpleNamespace(name=name, **image) for name in names}
        self.cameras = {1: SimpleNamespace(width=width, height=height)}

    def num_reg_images(self) -> int:
        return len(self.images)

    def num_points3D(self) -> int:
        return 100

    def write(self, folder: Path) -> None:
        write_text(folder.parent)


def stand_in_for_colmap(monkeypatch: pytest.MonkeyPatch, depth: np.ndarray) -> None:
    monkeypatch.setattr(poses, "colmap", lambda place: None)
    monkeypatch.setattr(poses, "map_photos", lambda photos, *others: _Found(photos, depth))
    monkeypatch.setattr(poses, "read_model", lambda folder: None)
    monkeypatch.setattr(poses.Scale, "apply", lambda scale, model: None)


@pytest.mark.parametrize("metadata", [METADATA, "{}", '{"intrinsic": '])
def test_depth_of_a_record3d_rgbd_video_is_in_metres(
    tmp_path: Path, metadata: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """COLMAP alone is stood in for. Other films are whole pictures."""
    depth = np.broadcast_to(np.linspace(0.8, 4.2, 64, dtype=np.float32), (48, 64)).copy()
    depth[:8] = 0
    pictures = [np.full((48, 64, 3), 40 + 50 * number, np.uint8) for number in range(4)]
    write_rgbd_video(tmp_path / "film.mp4", pictures, 4 * [depth], metadata)
    stand_in_for_colmap(monkeypatch, depth)
    assert main(["poses", str(tmp_path / "film.mp4"), "--json"]) == 0
    answer: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
    photos = sorted((tmp_path / "film/images").iterdir())
    if metadata != METADATA:
        assert answer["scale"] is None and not (tmp_path / "film/depth").exists()
        assert {cv2.imread(str(photo)).shape for photo in photos} == {(48, 128, 3)}
        return
    assert abs(answer["scale"] - 2) < 0.05 and {cv2.imread(str(photo)).shape for photo in photos} == {(48, 64, 3)}
    maps = sorted((tmp_path / "film/depth").iterdir())
    assert [each.stem for each in maps] == [each.stem for each in photos]
    for each in maps:
        found = np.load(each)
        assert found.dtype == np.float32 and not found[:6].any()
        np.testing.assert_allclose(found[12:], depth[12:], atol=0.12)
        assert np.median(np.abs(found[12:] - depth[12:])) < 0.04


@pytest.mark.parametrize("kind", ["png", "npy"])
def test_measured_depth_beside_photos_puts_their_poses_in_metres(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """PNG in millimetres, or NumPy's in metres. COLMAP alone is stood in for."""
    depth = np.broadcast_to(np.linspace(0.8, 4.2, 64, dtype=np.float32), (48, 64))
    (tmp_path / "depth").mkdir()
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), np.full((48, 64, 3), 50 * number, np.uint8))
        if kind == "png":
            cv2.imwrite(str(tmp_path / f"depth/{number}.png"), in_steps(depth.astype(np.float64), 1000))
        else:
            np.save(tmp_path / f"depth/{number}.npy", depth)
    cv2.imwrite(str(tmp_path / "conf_0.png"), np.zeros((48, 64), np.uint8))
    stand_in_for_colmap(monkeypatch, depth)
    assert main(["poses", str(tmp_path), "--json"]) == 0
    told = capsys.readouterr()
    assert "conf_0.png" in told.err and json.loads(told.out.splitlines()[-1])["scale"] == pytest.approx(2, abs=0.01)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs pycolmap (engine add colmap)")
def test_an_rgbd_video_of_the_sample_gets_poses_in_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    true = open_scene(ROOT / "sample/room")
    pictures = [frame.read_colour(None)[..., ::-1] for frame in true.frames]
    depths = [frame.depth(frame.size) for frame in true.frames]
    write_rgbd_video(tmp_path / "film.mp4", pictures, depths, METADATA)
    assert main(["poses", str(tmp_path / "film.mp4"), "--pictures", "72", "--json"]) == 0
    answer: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert answer["scale"] is not None and answer["posed"] > 60
    wanted = {f"{number:06d}": frame.camera.centre for number, frame in enumerate(true.frames)}
    made = open_scene(tmp_path / "film")
    found = np.array([frame.camera.centre for frame in made.frames])
    scale, errors = aligned(found, np.array([wanted[frame.name] for frame in made.frames]))
    assert made.has_depth and errors.mean() < 0.1 and abs(scale - 1.0) < 0.05, (scale, errors.mean())


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs pycolmap (engine add colmap)")
def test_unrelated_photos_are_refused_in_our_words_alone(shell: Terminal, tmp_path: Path) -> None:
    for number in range(5):
        noise = np.random.default_rng(number).integers(0, 255, (24, 32, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC))
    told = shell.run(POSES, code=2, PHOTOS=tmp_path)
    assert worded("poses-of-few").search(told) and "sparse model" not in told, "COLMAP has a line of its own"


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs pycolmap (engine add colmap)")
@pytest.mark.parametrize("has_depth", [True, False])
def test_poses_found_for_photos_are_written_to_sparse_0_beside_them(
    has_depth: bool, shell: Terminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of the sample, to some centimetres; measured depth beside them gives the unit."""
    sample, photos = ROOT / "sample/room", tmp_path / "photos"
    shutil.copytree(sample / "color", photos / "color")
    if has_depth:
        shutil.copytree(sample / "depth", photos / "depth")
    assert "72 of 72 photos" in shell.run(POSES, PHOTOS=photos)
    assert (photos / "sparse/0/images.bin").is_file()
    answer = answer_of(capsys, "poses", photos)
    assert answer["posed"] == 72 and (answer["scale"] is not None) is has_depth, "what an earlier call made is taken"
    made, true = open_scene(photos), open_scene(sample)
    assert made.has_depth is has_depth
    centres = {frame.name: frame.camera.centre for frame in made.frames}
    found = np.array([centres[frame.name] for frame in true.frames])
    scale, errors = aligned(found, np.array([frame.camera.centre for frame in true.frames]))
    assert errors.mean() < 0.05 and (abs(scale - 1.0) < 0.02 or not has_depth), (scale, errors.mean())
