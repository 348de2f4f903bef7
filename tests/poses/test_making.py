"""Poses of photos: with pycolmap the sample's own, to some centimetres; without it, what is missing is said."""

import json
import shutil
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import run_plgs
from engine import poses
from engine.command_line.main import main
from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, StopSignal
from engine.poses import Made, _digest_of, _median, make_poses, write_pictures
from engine.records import to_json
from engine.scene import open_scene
from tests.commands import exit_code
from tests.raises_key import raises_key
from tests.scene.formats.room import write_grey
from tests.scene.formats.test_colmap import write_text
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Photos as a phone keeps them, in one folder."""
    folder = write_tiny_scene(tmp_path / "scene", frames=6)
    return shutil.copytree(folder / "color", tmp_path / "photos")


def find_poses(place: Path, tmp_path: Path) -> None:
    make_poses(place, EventWriter(tmp_path / "events.jsonl"), StopSignal())


@pytest.mark.skipif(find_spec("pycolmap") is not None, reason="pycolmap is there")
def test_finding_poses_reports_a_missing_pycolmap(
    photos: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lift asks for poses first, by either command."""
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", sys.executable)
    before = {path.name for path in photos.iterdir()}
    with raises_key("lacks-part") as caught:
        find_poses(photos, tmp_path)
    assert caught.value.code is ErrorCode.LACKS_PART and caught.value.option == "colmap"
    assert {path.name for path in photos.iterdir()} == before
    for program, *first in ((main, "lift"), (run_plgs.main,)):
        assert exit_code(program, *first, photos, "--poses", "colmap", "-o", tmp_path / "lift") == 2
        assert "engine add colmap" in capfd.readouterr().err and not (tmp_path / "lift").exists()


def test_the_refusal_of_plain_photos_says_how_to_get_poses(photos: Path, tmp_path: Path) -> None:
    with raises_key("no-poses --poses") as caught:
        open_scene(photos)
    assert caught.value.code is ErrorCode.NO_POSES and len(caught.value.fix) < 200
    (tmp_path / "empty").mkdir()
    with pytest.raises(PlgsError) as other:
        open_scene(tmp_path / "empty")
    assert other.value.code is ErrorCode.BAD_INPUT


def test_finding_poses_is_refused_with_poses_or_without_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poses, "colmap", lambda photos: None)  # it is not asked for anything
    write_text(tmp_path / "walk")
    with raises_key("has-poses"):
        find_poses(tmp_path / "walk", tmp_path)
    (tmp_path / "empty").mkdir()
    with raises_key("no-photos"):
        find_poses(tmp_path / "empty", tmp_path)


def test_poses_of_photos_that_changed_are_not_used(photos: Path, tmp_path: Path) -> None:
    """Whatever lay there by now had the poses that were found for others."""
    (photos / "sparse" / "0").mkdir(parents=True)
    made = Made(photos, 6, 6, 100, None, _digest_of(sorted(photos.glob("*.png"))))
    (photos / "sparse" / "0" / "made_by.json").write_text(json.dumps(to_json(made)))
    assert make_poses(photos, EventWriter(tmp_path / "events.jsonl"), StopSignal()) == made
    (photos / "0001.png").write_bytes((photos / "0002.png").read_bytes())
    with raises_key("photos-changed"):
        find_poses(photos, tmp_path)


class _Mapped:
    """What COLMAP would find: four of four photos."""

    def num_reg_images(self) -> int:
        return 4

    def num_points3D(self) -> int:
        return 100

    def write(self, folder: Path) -> None:
        write_text(folder.parent)


@pytest.fixture
def mapped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses are found without COLMAP, one metre for each length where depth lies beside the photos."""
    unit = SimpleNamespace(metres=1.0, apply=lambda model: None)
    for name, stand_in in (
        ("colmap", lambda place: None),
        ("map_photos", lambda *all_of_it: _Mapped()),
        ("read_model", lambda folder: None),
        ("metres_per_length", lambda model, depths: unit),
    ):
        monkeypatch.setattr(poses, name, stand_in)


def write_film(path: Path, seed: int) -> None:
    cv2 = pytest.importorskip("cv2")
    random, film = (
        np.random.default_rng(seed),
        cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48)),
    )
    for _ in range(4):
        film.write(random.integers(0, 255, (48, 64, 3), np.uint8))
    film.release()


def told_of(film: Path, pictures: int | None) -> str:
    """The events of finding the poses of so many pictures."""
    told = film.with_name("told.jsonl")
    told.write_text("")
    make_poses(film, EventWriter(told), StopSignal(), pictures)
    return told.read_text()


def test_poses_of_another_film_of_the_same_name_are_not_used(mapped: None, tmp_path: Path) -> None:
    """Nor of one whose name has another end, nor those that were found for photos in a folder of its name."""
    film = tmp_path / "walk.mp4"
    write_film(film, 0)
    find_poses(film, tmp_path)
    find_poses(film, tmp_path)
    found = Made.read(tmp_path / "walk")
    assert found is not None and found.fps == 10
    assert "are used" not in (tmp_path / "events.jsonl").read_text()
    assert told_of(film, 300) == told_of(film, 150) == told_of(film, 4) == "", "the film has no more"
    assert "the poses of 4 pictures that were found before are used" in told_of(film, 3)
    shutil.copytree(tmp_path / "walk", tmp_path / "moved")
    film = film.rename(tmp_path / "moved.mp4")
    find_poses(film, tmp_path)
    write_film(film, 1)
    with raises_key("other-photos moved"):
        find_poses(film, tmp_path)
    write_film(tmp_path / "walk.avi", 1)
    with raises_key("other-photos"):
        find_poses(tmp_path / "walk.avi", tmp_path)
    shutil.rmtree(tmp_path / "moved" / "sparse")
    find_poses(tmp_path / "moved", tmp_path)
    with raises_key("other-photos"):
        find_poses(film, tmp_path)


@pytest.mark.parametrize("stopped", [KeyboardInterrupt, None])
def test_making_poses_keeps_a_strangers_files_in_a_films_folder(
    stopped: type[BaseException] | None, mapped: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is refused while they are there, and a stopped run takes only its own away."""
    film, notes = tmp_path / "walk.mp4", tmp_path / "walk/images/notes.txt"
    write_film(film, 0)

    def interrupted(photos: Path, *others: object) -> object:
        notes.write_text("mine")
        if stopped is None:
            return _Mapped()
        raise stopped

    monkeypatch.setattr(poses, "map_photos", interrupted)
    with suppress(KeyboardInterrupt):
        find_poses(film, tmp_path)
    assert notes.read_text() == "mine" and (tmp_path / "walk/sparse").exists() is (stopped is None)
    assert len([*(tmp_path / "walk/images").glob("*.jpg")]) == (4 if stopped is None else 0)
    if stopped is not None:
        with raises_key("exists"):
            find_poses(film, tmp_path)
    assert notes.read_text() == "mine"


def test_poses_scaled_by_depth_that_changed_are_not_used(mapped: None, photos: Path, tmp_path: Path) -> None:
    (photos / "depth").mkdir()
    write_grey(photos / "depth" / "0001.png", np.full((6, 8), 1000, np.uint16))
    find_poses(photos, tmp_path)
    find_poses(photos, tmp_path)
    write_grey(photos / "depth" / "0001.png", np.full((6, 8), 2000, np.uint16))
    with raises_key("depth-changed"):
        find_poses(photos, tmp_path)


@pytest.mark.parametrize("name", ["depth_{}", "conf_{}", "{}.depth", "frame-{}.depth.proj", "{}_DepthMap", "{}_mm"])
def test_depth_maps_are_no_photos(name: str, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As 3D Scanner App, NeRFCapture and others keep them, beside the photos; the last is known by its 16 bits."""
    given: list[str] = []
    monkeypatch.setattr(poses, "colmap", lambda photos: None)
    monkeypatch.setattr(poses, "map_photos", lambda photos, names, *others: given.extend(names))
    wanted = sorted(path.name for path in photos.iterdir())
    for number in range(7):
        write_grey(photos / f"{name.format(number)}.png", np.zeros((6, 8), np.uint16 if "mm" in name else np.uint8))
    write_grey(photos / "indepth_confocal.png", np.zeros((6, 8), np.uint8))  # a grey photo
    with raises_key("poses-of-few"):
        find_poses(photos, tmp_path)
    assert given == sorted([*wanted, "indepth_confocal.png"])
    assert "7 pictures are left out, as they show depth or confidence" in (tmp_path / "events.jsonl").read_text()
    for photo in given:
        (photos / photo).unlink()
    with raises_key("no-photos"):
        find_poses(photos, tmp_path)


def test_inconsistent_depth_is_not_used_to_scale_poses() -> None:
    random = np.random.default_rng(0)
    good = 2.5 * random.normal(1.0, 0.02, 400)
    found = _median(np.concatenate([good, random.uniform(0.1, 90.0, 100)]))
    assert found is not None and abs(found.metres - 2.5) < 0.1
    assert _median(good[:20]) is None and _median(random.uniform(0.1, 90.0, 400)) is None


def test_the_sharpest_pictures_of_a_film_are_extracted(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    random = np.random.default_rng(0)
    film = cv2.VideoWriter(str(tmp_path / "film.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48))
    sharp = random.integers(0, 255, (48, 64, 3), np.uint8)
    for number in range(12):
        film.write(sharp if number % 4 == 3 else cv2.blur(sharp, (9, 9)))
    film.release()
    done: list[tuple[int, int]] = []
    write_pictures(tmp_path / "film.mp4", tmp_path / "out", 3, lambda *each: done.append(each))
    assert [path.name for path in sorted((tmp_path / "out/images").iterdir())] == [
        "000003.jpg",
        "000007.jpg",
        "000011.jpg",
    ]
    assert done == [(1, 3), (2, 3), (3, 3)]


def aligned(found: np.ndarray, wanted: np.ndarray) -> tuple[float, np.ndarray]:
    """The scale of the similarity (Umeyama) that brings places [N, 3] to others, and the distances left [N]."""
    one, other = found - found.mean(0), wanted - wanted.mean(0)
    left, values, right = np.linalg.svd(other.T @ one)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = float((values * signs).sum() / (one**2).sum())
    return scale, np.linalg.norm(other - scale * one @ (left * signs @ right).T, axis=1)
