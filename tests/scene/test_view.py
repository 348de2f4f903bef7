"""Frames read at the size of the lift, and by several threads: in their order, and only a few ahead."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.scene import Camera, Frame, load_view, open_scene, size_within
from engine.scene.view import READERS, SEAM, read_ahead
from tests.tiny_scene import write_tiny_scene

SIZE, HALF = (320, 240), (160, 120)
THICK = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frame 0001 has the black borders that an undistortion leaves at the upper and the lower side."""
    folder = write_tiny_scene(tmp_path_factory.mktemp("scene"), frames=2, size=SIZE)
    path = folder / "color" / "0001.png"
    picture = cv2.imread(str(path))
    assert picture is not None
    picture = np.maximum(picture, 60)
    picture[:THICK] = 0
    picture[-THICK:] = 0
    cv2.imwrite(str(path), picture)
    return folder


@pytest.mark.parametrize("size", [None, HALF])
def test_black_borders_are_found_at_any_size(folder: Path, size: tuple[int, int] | None) -> None:
    border = load_view(open_scene(folder).frames[1], size).border
    width, height = size or SIZE
    thick = THICK * width // SIZE[0]
    assert border is not None and border.shape == (height, width)
    assert border[:thick].all() and border[-thick:].all()
    assert not border[thick + SEAM : -thick - SEAM].any()


def test_sizes_keep_their_aspect_and_never_grow() -> None:
    assert size_within((640, 480), (320, 320)) == (320, 240)
    assert size_within((480, 640), (320, 320)) == (240, 320)
    assert size_within((100, 50), (320, 320)) == (100, 50)
    assert size_within((5000, 3), (100, 100)) == (100, 1)


CAMERA = Camera(4, 3, 1.0, 1.0, 2.0, 1.5, np.eye(4))
FRAMES = [
    Frame(f"{number}", CAMERA, False, Path("x.png"), None, lambda size: np.zeros((3, 4, 3), np.uint8), None, None)
    for number in range(20)
]


def test_the_order_is_kept_whichever_comes_first() -> None:
    """The second frame is done before the first one may be."""
    second_is_done = threading.Event()

    def read(frame: Frame) -> str:
        if frame.name == "0":
            assert second_is_done.wait(20)
        if frame.name == "1":
            second_is_done.set()
        return frame.name

    assert list(read_ahead(FRAMES, read)) == [frame.name for frame in FRAMES]


def test_no_more_is_read_than_a_few_frames_ahead() -> None:
    begun: list[str] = []

    def read(frame: Frame) -> str:
        begun.append(frame.name)
        return frame.name

    reading = read_ahead(FRAMES, read)
    assert next(reading) == "0"
    assert len(begun) <= 2 * READERS + 1
    reading.close()  # type: ignore[attr-defined]
    assert len(begun) <= 2 * READERS + 1


def test_a_bad_frame_is_reported_when_it_is_reached() -> None:
    def read(frame: Frame) -> str:
        if frame.name == "7":
            raise PlgsError("it is bad", frame.colour_path, "Mend it.")
        return frame.name

    reading = read_ahead(FRAMES, read)
    assert [next(reading) for _ in range(7)] == [str(number) for number in range(7)]
    with pytest.raises(PlgsError, match="bad"):
        next(reading)


def test_frames_of_one_file_are_read_by_one_thread() -> None:
    frames = [replace(frame, file_shows_colour=False) for frame in FRAMES]
    assert set(read_ahead(frames, lambda frame: threading.get_ident())) == {threading.get_ident()}


def test_a_view_sees_what_its_own_depth_shows(folder: Path) -> None:
    """Places on the rays of some pixels: at the depth there, 4 cm and 6 cm beside it where 2 % of it is less, behind
    the camera, and one where there is no depth."""
    view = load_view(open_scene(folder).frames[0])
    y, x = np.array([10, 60, 90, 120, 200]), np.array([20, 100, 30, 160, 300])
    depth = np.full_like(view.depth, 1.5)
    depth[200, 300] = 0.0
    beside = np.array([0.0, 0.04, 0.06, -3.0, 0.0])
    moved = depth.copy()
    moved[y, x] += np.float32(beside)
    moved[200, 300] = 1.5
    places = view.camera.unproject(moved)[y, x]
    number, rows, columns = replace(view, depth=depth).seen_of(places)
    assert [*number] == [0, 1] and [*rows] == [10, 60] and [*columns] == [20, 100]
