"""Cameras and pictures come without masks and depth; a lift does not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from engine.command_line.main import main
from engine.errors import PlgsError
from engine.posed.plain_folders import open_plain_folders
from engine.scene import check_scene, describe, load_view, open_scene, open_scene_to_lift, require_liftable
from engine.scene_source import SceneSource
from tests.scene.formats.room import check_on_room
from tests.scene.formats.test_nerfstudio import write_scene
from tests.scene.refusing import refuses
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene", frames=6)


def test_up_to_half_of_the_frames_may_lack_depth(tmp_path: Path) -> None:
    """A file that does not name depth for every frame, as some apps write it."""
    write_scene(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    last = sorted(content["frames"], key=lambda frame: -int(frame["file_path"].split("_")[1][:-4]))
    for lacking, frame in enumerate(last[:4], start=1):
        del frame["depth_file_path"]
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        scene = open_scene(tmp_path)
        assert scene.has_depth is (lacking <= 3) and len(scene.frames) == (6 - lacking if lacking <= 3 else 6)
        some = f"{lacking} frames without readable depth are" if lacking > 1 else "1 frame without readable depth is"
        how = f"{some} left out: " if lacking <= 3 else "4 of 6 frames have no "
        assert any(warning.startswith(how) for warning in scene.warnings)
        if lacking == 1:
            check_on_room(scene)
    with pytest.raises(PlgsError, match="4 of 6 frames have no depth .frame_"):
        require_liftable(scene)


def test_nothing_is_left_to_measure_when_the_held_out_frames_lack_depth(folder: Path) -> None:
    (folder / "depth" / "0004.png").unlink()
    scene = open_scene(folder)
    assert not scene.test_frames and scene.warnings == (
        "1 frame without readable depth is left out: 0004",
        "no frame is held out: nothing is measured on unseen views",
    )
    assert [frame.name for frame in open_plain_folders(SceneSource(folder)).frames] == [
        frame.name for frame in scene.frames
    ]


@pytest.mark.parametrize(("without", "told"), [("panoptic.json", "there are no masks"), ("depth", "has no depth")])
def test_it_opens_without_masks_but_does_not_lift(folder: Path, without: str, told: str) -> None:
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
    with pytest.raises(PlgsError, match=told):
        open_scene_to_lift(SceneSource(folder))


def test_the_command_line_explains_itself(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "panoptic.json").unlink()
    assert main(["inspect", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "masks     none" in out and "format    scannet" in out
    assert main(["lift", str(folder), "-o", str(tmp_path / "out")]) == 2
    assert "there are no masks" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_an_unknown_format_is_refused_and_a_known_one_can_be_named(folder: Path) -> None:
    assert open_scene(folder, scene_format="scannet").format == "scannet"
    refuses('no format is called "photos".*Choose one of scannet', folder, scene_format="photos")


def test_an_unknown_layout_is_answered_with_advice(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    refuses("need poses: .*COLMAP.*--format scannet", tmp_path)
    with pytest.raises(PlgsError) as caught:
        open_scene(tmp_path)
    assert len(caught.value.fix) < 400
    refuses("the folders color|color", tmp_path, scene_format="scannet")
