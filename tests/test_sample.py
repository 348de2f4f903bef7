"""The sample's programs: the hand-held twin of a scene, and masks as a network would draw them."""

import importlib
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.refusing import check_scene
from tests.tiny_scene import write_tiny_scene

SAMPLE = Path(__file__).resolve().parents[1] / "sample"
ROOM = SAMPLE / "room"
sys.path.append(str(SAMPLE))  # its programs import each other as scripts do
hand_held, mask_noise, network_masks = map(importlib.import_module, ("hand_held", "mask_noise", "network_masks"))

FRAMES = 12


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    splits = {"train": [f"{i:04d}" for i in range(FRAMES - 1)], "test": [f"{FRAMES - 1:04d}"]}
    return write_tiny_scene(tmp_path_factory.mktemp("exact"), frames=FRAMES, size=(160, 120), splits=splits)


@pytest.fixture(scope="module")
def captured(exact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("captured") / "scene"
    hand_held.write_hand_held(exact, out, seed=0)
    return out


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_degraded_sample_opens_without_warnings(exact: Path, captured: Path) -> None:
    scene, source = open_scene(captured), open_scene(exact)
    assert (*scene.warnings, *check_scene(scene)) == (*source.warnings, *check_scene(source)) == ()
    assert [frame.size for frame in scene.frames] == [(160, 120)] * FRAMES
    assert {frame.read_depth(None).shape for frame in scene.frames} == {(60, 80)}


def test_the_degraded_sample_is_the_same_for_the_same_seed(exact: Path, captured: Path, tmp_path: Path) -> None:
    hand_held.write_hand_held(exact, tmp_path / "again", seed=0)
    hand_held.write_hand_held(exact, tmp_path / "other", seed=1)
    first, again, other = bytes_of(captured), bytes_of(tmp_path / "again"), bytes_of(tmp_path / "other")
    assert first == again
    changed = [name for name in first if name.split("/")[0] in ("color", "depth", "pose")]
    assert len(changed) == 3 * FRAMES and all(first[name] != other[name] for name in changed)


def test_degrading_the_sample_keeps_truth_masks_and_intrinsics(exact: Path, captured: Path) -> None:
    before, after = bytes_of(exact), bytes_of(captured)
    assert {*after} - {*before} == {"hand_held.json"} and {*before} <= {*after}
    kept = [name for name in before if name.split("/")[0] not in ("color", "depth", "pose")]
    assert {name.split("/")[0] for name in kept} == {"gt", "intrinsic", "panoptic", "panoptic.json", "splits.json"}
    assert [name for name in kept if before[name] != after[name]] == []
    faults = json.loads(after["hand_held.json"])
    assert faults["seed"] == 0 and [frame["frame"] for frame in faults["frames"]] == [f"{i:04d}" for i in range(FRAMES)]


def test_poses_of_the_degraded_sample_are_slightly_wrong_but_rigid(exact: Path, captured: Path) -> None:
    shifts, turns = [], []
    for before, after in zip(open_scene(exact).frames, open_scene(captured).frames, strict=True):
        right, wrong = before.camera.camera_to_world, after.camera.camera_to_world
        assert np.allclose(wrong[:3, :3].T @ wrong[:3, :3], np.eye(3), atol=1e-8)
        shifts.append(np.linalg.norm(wrong[:3, 3] - right[:3, 3]))
        turns.append(np.degrees(np.linalg.norm(cv2.Rodrigues(right[:3, :3].T @ wrong[:3, :3])[0])))
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(0.005, rel=0.01) and max(shifts) < 0.02
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(0.3, rel=0.01) and max(turns) < 1.2


@pytest.mark.parametrize("bad", ["exists", "inside", "no scene", "few poses"])
def test_the_sample_program_gives_one_line_errors_for_bad_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bad: str
) -> None:
    scene, out = write_tiny_scene(tmp_path / "scene", frames=6), tmp_path / "out"
    if bad == "exists":
        out.mkdir()
    if bad == "inside":
        out = scene / "out"
    if bad == "no scene":
        scene = tmp_path / "nothing"
    if bad == "few poses":
        for number in range(1, 5):  # a frame without a pose is left out, but not most of them
            (scene / f"pose/{number:04d}.txt").unlink()
    monkeypatch.setattr(sys, "argv", ["hand_held.py", str(scene), str(out)])
    assert hand_held.main() == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1
    assert not (out.exists() and any(out.iterdir()))


def test_the_samples_masks_are_what_its_program_makes() -> None:
    table, splits = json.loads((ROOM / "panoptic.json").read_text()), json.loads((ROOM / "splits.json").read_text())
    things = {entry["id"]: entry["isthing"] for entry in table["categories"]}
    scene = open_scene(ROOM)
    frames = {frame.name: frame for frame in scene.frames}
    assert [image["id"] for image in table["images"]] == sorted(splits["train"] + splits["test"])
    for annotation in table["annotations"][5::24]:
        frame = annotation["image_id"]
        ids, segments = network_masks.mask_of_frame(frames[frame], scene.classes, 0, network_masks.MaskNoise())
        picture = cv2.imread(str(ROOM / "panoptic" / annotation["file_name"]), cv2.IMREAD_COLOR).astype(np.int32)
        assert np.array_equal(ids, picture[..., 2] + 256 * picture[..., 1] + 65536 * picture[..., 0])
        assert segments == annotation["segments_info"]
        numbers, counts = np.unique(ids[ids > 0], return_counts=True)
        painted = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
        assert painted == {segment["id"]: segment["area"] for segment in segments}
        assert all(segment["isthing"] == things[segment["category_id"]] for segment in segments)


def test_weak_masks_of_the_sample_program_are_wrong_more_often(
    exact: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = {}
    for name, more in (("good", ()), ("weak", ("--weak",))):
        monkeypatch.setattr(sys, "argv", ["network_masks.py", str(exact), *more, "--out", str(tmp_path / name)])
        network_masks.main()
        frames = open_scene(exact, tmp_path / name).frames
        right[name] = np.mean([frame.mask().class_map() == frame.read_ground_truth(None).semantic for frame in frames])
    assert 0.3 < right["weak"] < right["good"] - 0.02 and right["good"] < 0.99
    alike = {"a": True, "b": True, "c": True, "d": True, "e": True, "wall": False}
    chosen = mask_noise.confusions("a", alike)
    assert len(chosen) == 3 and chosen == mask_noise.confusions("a", alike) and not {"a", "wall"} & set(chosen)
