"""What is checked of a scene before a lift, and what a lift needs of it."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.posed.plain_folders import open_plain_folders
from engine.scene import load_view, open_scene, open_scene_to_lift, report_of, survey_scene
from engine.scene_source import SceneSource
from tests.raises_key import raises_key
from tests.scene.refusing import check_scene, describe, refuses
from tests.scene.test_bad_input import damaged
from tests.tiny_scene import write_tiny_scene


def test_frames_that_overlap_no_other_are_named(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=8)
    for number, name in enumerate(("0003", "0005"), start=1):
        path = folder / "pose" / f"{name}.txt"
        np.savetxt(path, np.loadtxt(path) + np.eye(4, k=3) * 50.0 * number)
    assert "2 frames hardly overlap with any other: 0003, 0005" in check_scene(open_scene(folder))


def test_poses_in_opengl_convention_give_two_warnings(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=8)
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.loadtxt(path) @ np.diag([1.0, -1.0, -1.0, 1.0]))
    scene = open_scene(folder)
    assert "OpenGL" in scene.warnings[0]
    assert check_scene(scene)[0].startswith("frames disagree about where surfaces are")


def test_checking_a_scene_reports_progress_and_can_be_stopped(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path, frames=5, size=(32, 24)))
    seen: list[tuple[int, int]] = []
    check_scene(scene, progress=lambda done, total: seen.append((done, total)))
    assert seen[:6] == [*((17 * frames, 100) for frames in range(1, 6)), (85, 100)] and seen == sorted(seen)
    assert 90 < seen[-1][0] <= 100  # also while frames are compared

    def cancel(done: int, total: int) -> None:
        if done == 34:  # two frames of five
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        check_scene(scene, progress=cancel)


def test_depth_beyond_any_room_gives_a_warning(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * 10)
    warnings = check_scene(open_scene(folder))
    assert warnings[0].endswith("which is far for a room: is it in millimetres?")


def in_16_bits(folder: Path, bits: int, names: str = "*") -> None:
    for path in (folder / "color").glob(names):
        pixels = cv2.imread(str(path)).astype(np.uint16) * 257 >> 16 - bits
        alpha = np.full_like(pixels[..., :1], 65535)
        cv2.imwrite(str(path), np.concatenate([pixels, alpha], axis=-1) if "1" in path.stem else pixels)


def test_photos_of_12_bits_are_reported_and_not_brightened(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    before = open_scene(folder).frames[1].read_colour(None)
    in_16_bits(folder, 12)
    (warning,) = check_scene(open_scene(folder))
    assert "as if they had 12 bits (the largest value is" in warning and "multiply their values by 16" in warning
    assert np.abs(open_scene(folder).frames[1].read_colour(None).astype(int) - before // 16).max() <= 1


@pytest.mark.parametrize("bits", [8, 10, 14])
def test_the_bits_of_dark_photos_are_inferred_and_told(tmp_path: Path, bits: int) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    in_16_bits(folder, bits)
    how = "dark" if bits == 14 else "nearly black"
    assert f"are {how}, as if they had {bits} bits" in check_scene(open_scene(folder))[0]


@pytest.mark.parametrize(("bits", "bits_of_one"), [(0, 0), (16, 12)], ids=["a covered lens", "a dark photo"])
def test_the_bit_depth_of_dark_photos_is_not_guessed(tmp_path: Path, bits: int, bits_of_one: int) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    in_16_bits(folder, bits)
    in_16_bits(folder, bits_of_one, "0002.png")
    assert check_scene(open_scene(folder)) == ()


def test_sparse_depth_and_empty_masks_give_warnings(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    depth = np.zeros((48, 64), np.uint16)
    depth[20:24, 30:34] = 1500
    cv2.imwrite(str(folder / "depth" / "0001.png"), depth)
    cv2.imwrite(str(folder / "panoptic" / "0002.png"), np.zeros((48, 64, 3), np.uint8))
    warnings = check_scene(open_scene(folder))
    assert "1 frame has depth on less than 5 % of the pixels: 0001" in warnings
    assert "1 frame has an empty mask: 0002" in warnings


def test_a_description_summarises_the_scene(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=9, depth_size=(32, 24))
    report = describe(open_scene(folder))
    assert (report.train_frames, report.test_frames, report.ground_truth_frames) == (8, 1, 9)
    assert report.colour_sizes == (((64, 48), 9),) and report.depth_sizes == (((32, 24), 9),)
    assert report.mask_sizes == (((64, 48), 9),)
    near, middle, far = report.depth_range
    assert 0.3 < near < middle < far < 5.0
    assert report.segments_per_frame == (4, 4, 4)
    assert [(entry.id, entry.name, entry.is_thing) for entry in report.classes][2] == (3, "cabinet", True)
    assert sum(entry.share for entry in report.classes) + report.void_share == pytest.approx(1.0)
    assert report.void_share == 0.0 and report.warnings == ()
    assert all(0.1 < length < 4.0 for length in report.extent)


@pytest.mark.parametrize(
    ("kind", "damage"),
    [
        ("color", lambda path: path.write_bytes(damaged(path.read_bytes()))),
        ("color", lambda path: path.write_bytes(b"")),
        ("depth", lambda path: cv2.imwrite(str(path), np.zeros((48, 64), np.uint16))),
        ("panoptic", lambda path: path.write_bytes(path.read_bytes()[:-20])),
    ],
)  # fmt: skip
def test_half_of_the_frames_may_be_unreadable(tmp_path: Path, kind: str, damage: Callable[[Path], object]) -> None:
    folder = write_tiny_scene(tmp_path, frames=5, size=(64, 48))
    files = sorted((folder / kind).iterdir())
    damage(files[1])
    survey = survey_scene(open_scene(folder))
    assert [frame.name for frame in survey.scene.frames] == ["0000", "0002", "0003", "0004"]
    assert [each.names for each in survey.scene.left_out] == [("0001",)]
    report = report_of(survey)
    assert sum("is left out: 0001" in warning for warning in report.warnings) == 1
    assert [len(each.names) for each in report.left_out] == [1]
    for path in (files[2], files[3]):
        damage(path)
    with pytest.raises(PlgsError):
        check_scene(open_scene(folder))


def test_everything_inferred_about_a_scene_is_listed_with_its_reason(tmp_path: Path) -> None:
    report = describe(open_scene(write_tiny_scene(tmp_path, frames=5)))
    assert [each.about for each in report.inferred] == ["format", "split"]
    assert all(each.taken and each.reason and str(each) not in report.warnings for each in report.inferred)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene", frames=6)


def test_a_scene_whose_held_out_frames_lack_depth_gives_a_warning(folder: Path) -> None:
    (folder / "depth" / "0004.png").unlink()
    scene = open_scene(folder)
    assert not scene.test_frames and scene.warnings == (
        "1 frame without readable depth is left out: 0004",
        "no frame is held out: nothing is measured on unseen views",
    )
    assert [frame.name for frame in open_plain_folders(SceneSource(folder)).frames] == [
        frame.name for frame in scene.frames
    ]


@pytest.mark.parametrize(("without", "told"), [("panoptic.json", "no-masks"), ("depth", "no-depth")])
def test_a_scene_without_masks_opens_but_is_not_lifted(folder: Path, without: str, told: str) -> None:
    path = folder / without
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    scene = open_scene(folder)
    assert len(scene.frames) == 6
    assert (scene.has_masks, scene.has_depth) == (without != "panoptic.json", without != "depth")
    report = describe(scene)
    assert (report.segments_per_frame is None) is not scene.has_masks
    assert (report.depth_range is None) is not scene.has_depth
    for needs_both in (check_scene, lambda scene: load_view(scene.frames[0])):
        with pytest.raises(PlgsError):
            needs_both(scene)
    with raises_key(told):
        open_scene_to_lift(SceneSource(folder))


def test_unknown_scene_layouts_are_answered_with_advice(folder: Path, tmp_path: Path) -> None:
    refuses("unknown-format photos scannet", folder, scene_format="photos")
    (tmp_path / "photos").mkdir()
    assert len(refuses("no-format --format scannet", tmp_path / "photos").fix) < 400
