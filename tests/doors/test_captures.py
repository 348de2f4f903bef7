"""What docs/captures.md promises."""

import json
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
from tests.conftest import ROOT
from tests.poses.test_making import aligned
from tests.scene.formats.test_colmap import write_text

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
        names = [path.name for path in photos.iterdir()]
        image = {"camera_id": 1, "has_pose": True, "points2D": seen, "cam_from_world": lambda: pose}
        self.images = {name: SimpleNamespace(name=name, **image) for name in names}
        self.cameras = {1: SimpleNamespace(width=width, height=height)}

    def num_reg_images(self) -> int:
        return len(self.images)

    def num_points3D(self) -> int:
        return 100

    def write(self, folder: Path) -> None:
        write_text(folder.parent)


@pytest.mark.parametrize("metadata", [METADATA, "{}", '{"intrinsic": '])
def test_of_record3ds_rgbd_video_both_are_written_and_the_depth_gives_the_unit(
    tmp_path: Path, metadata: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """COLMAP alone is stood in for. Other films are whole pictures."""
    depth = np.broadcast_to(np.linspace(0.8, 4.2, 64, dtype=np.float32), (48, 64)).copy()
    depth[:8] = 0
    pictures = [np.full((48, 64, 3), 40 + 50 * number, np.uint8) for number in range(4)]
    write_rgbd_video(tmp_path / "film.mp4", pictures, 4 * [depth], metadata)
    monkeypatch.setattr(poses, "colmap", lambda place: None)
    monkeypatch.setattr(poses, "map_photos", lambda photos, *others: _Found(photos, depth))
    monkeypatch.setattr(poses, "read_model", lambda folder: None)
    monkeypatch.setattr(poses.Scale, "apply", lambda scale, model: None)
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


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs pycolmap (engine add colmap)")
def test_a_rgbd_video_of_the_sample_gets_its_poses_in_metres(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
