"""Frames as plain files: what a video, an archive or a bent lens hides, and what depth shows."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.frames import CloudBuilder, make_frames
from engine.known_scene import MadeFrames
from engine.scene import Camera, open_scene
from engine.scene_source import SceneSource
from tests.raises_key import raises_key
from tests.scene.formats.room import distance_to_room
from tests.scene.formats.test_scannet import COLOUR, sens
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """A scene whose pictures no image file shows."""
    path = tmp_path / "scan.sens"
    path.write_bytes(sens())
    return path


def image(path: Path | None) -> np.ndarray:
    """uint8 [H, W, 3] RGB."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert pixels is not None, path
    return pixels[..., ::-1]


def test_frames_of_an_archive_are_extracted(archive: Path, tmp_path: Path) -> None:
    scene, source = open_scene(archive), SceneSource(archive)
    done = []
    made = make_frames(scene, source, tmp_path / "out", progress=lambda *step: done.append(step))
    assert done == [(i + 1, 6) for i in range(6)] and MadeFrames.read(tmp_path / "out") == made
    for frame in scene.frames:
        files = made.frames[frame.name]
        shown = image(files.colour)
        assert shown.shape == (COLOUR.height, COLOUR.width, 3) and files.masks is None
        assert np.abs(shown.astype(int) - frame.read_colour(None)).mean() < 3.0  # JPEG
        depth = frame.depth()
        assert image(files.depth).shape[:2] == depth.shape
        assert depth.min() <= files.depth_range[0] < files.depth_range[1] <= depth.max()


def test_the_extracted_point_cloud_lies_on_the_walls_of_the_room(archive: Path, tmp_path: Path) -> None:
    made = make_frames(open_scene(archive), SceneSource(archive), tmp_path / "out", kinds=["cloud"])
    assert made.cloud is not None and made.frames["0"].colour is None
    with np.load(made.cloud) as stored:
        xyz, rgb = stored["xyz"], stored["rgb"]
    assert len(xyz) > 2000 and xyz.dtype == np.float32 and rgb.dtype == np.uint8
    assert (distance_to_room(xyz) < 0.06).mean() > 0.97
    floor = rgb[(xyz[:, 2] < 0.02) & (distance_to_room(xyz) < 0.02)]
    assert np.abs(np.median(floor, axis=0) - [120, 80, 50]).max() < 4


def test_extracting_frames_again_makes_only_missing_ones(archive: Path, tmp_path: Path) -> None:
    scene, source, out = open_scene(archive), SceneSource(archive), tmp_path / "out"
    make_frames(scene, source, out, kinds=["colour"], names=["0", "1"])
    (out / "color" / "1.jpg").unlink()
    before = (out / "color" / "0.jpg").stat()
    made = make_frames(scene, source, out, kinds=["colour", "depth"], names=["1", "2"])
    assert set(made.frames) == {"0", "1", "2"} and made.frames["0"].depth is None
    assert (out / "color" / "0.jpg").stat().st_ino == before.st_ino and image(made.frames["1"].colour).size
    os.utime(archive, (before.st_mtime + 10, before.st_mtime + 10))
    make_frames(scene, source, out, kinds=["colour"], names=["0"])
    assert (out / "color" / "0.jpg").stat().st_ino != before.st_ino, "the scene is newer"


def test_extracted_pictures_are_made_again_when_the_scene_is_replaced(tmp_path: Path) -> None:
    """Its files may be older, as those that come out of an archive: then pictures and cloud of the first one stayed."""
    place, out = tmp_path / "scan.sens", tmp_path / "out"
    room = write_tiny_scene(tmp_path / "room", frames=6)
    place.write_bytes(sens())
    first = make_frames(open_scene(place), SceneSource(place), out)
    place.unlink()
    room.rename(place)
    made = make_frames(open_scene(place), SceneSource(place), out, kinds=["depth"])
    assert first.cloud is not None and made.cloud is None and not {*first.frames} & {*made.frames}
    before = (out / "depth" / "0000.png").stat().st_ino
    pose = place / "pose" / "0000.txt"
    moved = np.loadtxt(pose)
    moved[0, 3] += 0.1
    np.savetxt(pose, moved)
    made = make_frames(open_scene(place), SceneSource(place), out, kinds=["depth"])
    assert image(made.frames["0000"].depth).size and (out / "depth" / "0000.png").stat().st_ino != before


def test_extracting_unknown_frames_or_into_other_folders_is_refused(archive: Path, tmp_path: Path) -> None:
    scene, out = open_scene(archive), tmp_path / "out"
    with raises_key("not-a-frame 17"):
        make_frames(scene, SceneSource(archive), out, names=["17"])
    make_frames(scene, SceneSource(archive), out, kinds=["colour"], names=["0"])
    with raises_key("folder-used"):
        make_frames(scene, SceneSource(archive, up="y"), out)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with raises_key("folder-used"):
        make_frames(scene, SceneSource(archive), tmp_path / "notes")
    (out / "frames.json").write_text(json.dumps({"format": 1, "source": {}}))
    with raises_key("other-format frames.json"):
        make_frames(scene, SceneSource(archive), out)


@pytest.mark.parametrize(
    ("kinds", "told"), [(["masks"], "nothing-to-write"), (["cloud", "depth", "masks"], "nothing-to-write")]
)
def test_extracting_pictures_that_a_scene_lacks_is_refused(kinds: list[str], told: str, tmp_path: Path) -> None:
    room = write_tiny_scene(tmp_path / "room", frames=2)
    scene = open_scene(room)
    bare = replace(scene, frames=tuple(replace(frame, read_mask=None, read_depth=None) for frame in scene.frames))
    with raises_key(told):
        make_frames(bare, SceneSource(room), tmp_path / "out", kinds=kinds)
    assert not (tmp_path / "out").exists()
    made = make_frames(bare, SceneSource(room), tmp_path / "out", kinds=["colour", *kinds])
    assert made.cloud is None and all(each.masks is None for each in made.frames.values())
    assert [each.name for each in made.scene.posed_frames(room)] == [each.name for each in scene.frames]


def test_bad_depth_prevents_the_cloud_but_not_the_pictures(archive: Path, tmp_path: Path) -> None:
    archive.write_bytes(archive.read_bytes()[:-1000] + bytes(1000))
    with raises_key("other-size"):
        make_frames(open_scene(archive), SceneSource(archive), tmp_path / "out", kinds=["colour", "cloud"])
    made = MadeFrames.read(tmp_path / "out")
    assert made.cloud is None and all(each.colour is not None for each in made.frames.values())


def test_a_point_cloud_is_thinned_to_its_limit_and_keeps_its_mean() -> None:
    camera = Camera(40, 30, 30.0, 30.0, 20.0, 15.0, np.eye(4))
    depth = np.random.default_rng(0).uniform(1.0, 4.0, (30, 40)).astype(np.float32)
    colour = np.full((30, 40, 3), (10, 20, 30), np.uint8)
    builder = CloudBuilder(cap=100)
    for _ in range(3):
        builder.add(camera, depth, colour)
    builder.add(camera, np.zeros_like(depth), colour)
    cloud = builder.cloud()
    assert 10 < len(cloud.xyz) <= 100 and (cloud.rgb == (10, 20, 30)).all()
    points = camera.unproject(depth).reshape(-1, 3)
    assert (cloud.xyz.min(0) >= points.min(0) - 1e-5).all() and (cloud.xyz.max(0) <= points.max(0) + 1e-5).all()
