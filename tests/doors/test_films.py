"""What docs/captures.md promises of films and photos, through the commands as printed."""

import json
import os
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from engine.command_line.main import main
from engine.poses import Made
from engine.records import to_json
from engine.scene import open_scene
from tests.commands import exit_code
from tests.scene.test_depth import write_colmap
from tests.segment.tiny_mask2former import save_tiny_mask2former
from tests.tiny_scene import write_tiny_scene

pytest.importorskip("transformers", reason="needs transformers (requirements/segment.txt)")
from tests.depth.test_making import ROOM, save_tiny_depth_network  # noqa: E402


@pytest.fixture
def film(tmp_path: Path) -> Path:
    return write_film(tmp_path)


def write_film(tmp_path: Path) -> Path:
    """A film whose poses were found, as `python -m engine poses` leaves it: the folder of its name beside it."""
    import cv2

    path = tmp_path / "room.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (64, 48))
    for _ in range(4):
        video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    folder = write_colmap(tmp_path / "room")
    made = Made(folder, 6, 6, 305, None)
    (folder / "sparse" / "0" / "made_by.json").write_text(json.dumps(to_json(made)))
    return path


def test_prepare_makes_missing_poses_depth_and_masks_of_a_film(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth_model = save_tiny_depth_network(tmp_path / "depth_network")
    masks = save_tiny_mask2former(tmp_path / "masks_network")
    command = ["prepare", film, "--masks-model", masks, "--depth-model", depth_model]
    assert exit_code(main, *command) == 0
    told = capsys.readouterr()
    assert "Making depth of 6 frames, in about" in told.err and "Making masks of 5 of 5 frames" in told.err
    folder = film.with_suffix("")
    scene = open_scene(folder)
    assert told.out.strip().endswith(str(folder)) and scene.has_depth and scene.has_masks
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert exit_code(main, *command) == 0
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()} == before
    shutil.rmtree(folder / "panoptic")
    (folder / "panoptic.json").unlink()
    assert exit_code(main, *command, "--have", "masks") == 0 and not (folder / "panoptic.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs pycolmap (engine add colmap)")
@pytest.mark.parametrize("name", ["walk.mp4", "photos"])
def test_a_film_or_a_folder_of_photos_is_lifted_by_one_command(name: str, tmp_path: Path) -> None:
    """With networks of random weights: what they find contradicts itself, so the lift must be told to go on."""
    import cv2

    source, lift, pictures = tmp_path / name, tmp_path / "lift", ROOM / "color"
    if name == "photos":
        shutil.copytree(pictures, source)
    else:
        video = cv2.VideoWriter(str(source), cv2.VideoWriter_fourcc(*"mp4v"), 10, (320, 240))
        for picture in sorted(pictures.iterdir()):
            video.write(cv2.imread(str(picture)))
        video.release()
    networks = save_tiny_mask2former(tmp_path / "masks_network"), save_tiny_depth_network(tmp_path / "depth_network")
    assert exit_code(main, "prepare", source, "--masks-model", networks[0], "--depth-model", networks[1]) == 0
    assert exit_code(main, "lift", source, "-o", lift, "--preset", "draft", "--steps", "20", "--anyway") == 0
    told = " ".join(json.loads((lift / "result" / "manifest.json").read_text())["estimated"])
    assert str(networks[1]) in told and "scale, which is unknown" in told
    assert (lift / "result" / "gaussians.ply").stat().st_size > 10_000


def test_lifting_a_film_first_lists_what_must_be_downloaded(
    film: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hub"))
    assert exit_code(main, "lift", film, "-o", tmp_path / "lift") == 2
    said = capfd.readouterr().err
    assert "99 MB" in said and "Apache-2.0" in said and "276 MB" in said and "CC BY-NC 4.0" in said
    assert "forbids commercial use" in said and "--download" in said and not (tmp_path / "lift").exists()


def test_lifting_plain_photos_lists_the_packages_that_are_missing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = shutil.copytree(write_tiny_scene(tmp_path / "scene", frames=6) / "color", tmp_path / "photos")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hub"))
    assert exit_code(main, "lift", photos, "-o", tmp_path / "lift") == 2
    said = capfd.readouterr().err
    assert ("engine add colmap" if find_spec("pycolmap") is None else "--download") in said
    assert not (tmp_path / "lift").exists()


@pytest.mark.parametrize(
    "kind", ["missing", "missing.mp4", "folder", "fifo", "fifo.mp4", "empty.mp4", "cut.mp4", "text.mp4"]
)
def test_a_file_that_is_no_film_is_refused_before_any_download_is_proposed(
    kind: str, film: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / kind
    if kind == "folder":
        place.mkdir()
    elif kind.startswith("fifo"):
        os.mkfifo(place)
    elif not kind.startswith("missing"):
        whole = film.read_bytes()
        place.write_bytes({"empty": b"", "cut": whole[: len(whole) // 3], "text": b"no film\n" * 99}[place.stem])
    before = sorted(tmp_path.iterdir())
    assert exit_code(main, "prepare", place) == 2
    said = capfd.readouterr().err  # FFmpeg may say that the film has no index
    line = said.splitlines()[-1]
    assert line.startswith("error: ") and kind in line and "downloaded" not in said and "Traceback" not in said
    assert sorted(tmp_path.iterdir()) == before
