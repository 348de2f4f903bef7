"""Views: a frame's pixels at one size, its black borders, how much its word counts, sequences that hold nothing."""

import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.errors import PlgsError
from engine.scene import Camera, Frame, StoredViews, load_view, open_scene, resolution_of, size_within
from engine.scene.view import MAKERS, SEAM, border_mask, read_ahead
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene

WIDTH, HEIGHT = 640, 480
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def room() -> Picture:
    """A made-up photo: soft shapes, sensor noise, nothing black at its sides."""
    random = np.random.default_rng(0)
    shapes = cv2.resize(random.uniform(60, 230, (6, 8, 3)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.clip(shapes + random.normal(0, 4, shapes.shape), 40, 255).astype(np.uint8)


def as_jpeg(picture: Picture) -> Picture:
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def undistorted(picture: Picture, bend: float) -> tuple[Picture, Mask]:
    """A photo of a lens with this radial distortion, made straight, and where nothing was seen."""
    camera = np.array([[500.0, 0.0, 325.0], [0.0, 500.0, 236.0], [0.0, 0.0, 1.0]])
    lens = np.array([bend, 0.0, 0.0, 0.0])
    # All that was seen stays in the picture, as tools do it that keep every pixel.
    straight, _ = cv2.getOptimalNewCameraMatrix(camera, lens, (WIDTH, HEIGHT), 1) if bend < 0 else (camera, None)
    seen = cv2.undistort(np.full((HEIGHT, WIDTH), 255, np.uint8), camera, lens, None, straight)
    return np.asarray(cv2.undistort(picture, camera, lens, None, straight), np.uint8), seen == 0


@pytest.mark.parametrize("bend", [-0.1, 0.1])
def test_the_black_border_of_an_undistorted_photo_is_found(bend: float) -> None:
    """Barrel distortion leaves bows along the sides, pincushion distortion wedges in the corners."""
    photo, unseen = undistorted(room(), bend)
    assert 0.02 < unseen.mean() < 0.1
    found = border_mask(as_jpeg(photo))
    assert found[unseen].mean() > 0.95
    near = cv2.dilate(unseen.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0
    assert not found[~near].any()


@pytest.mark.parametrize("thick", [1, 24])
def test_a_straight_black_bar_counts_as_border(thick: int) -> None:
    for turns in range(4):
        photo, expected = room(), np.zeros((HEIGHT, WIDTH), bool)
        np.rot90(photo, turns)[:thick] = 0
        np.rot90(expected, turns)[: thick + 2] = True
        np.testing.assert_array_equal(border_mask(photo), expected)


def dark_cupboard() -> Picture:
    """Black, but a real surface: noise, and some light in it."""
    photo = room()
    random = np.random.default_rng(1)
    photo[HEIGHT - 40 :, 100:400] = random.normal(6, 2, (40, 300, 3)).clip(0, 12).astype(np.uint8)
    return photo


def deep_shadow() -> Picture:
    """Black without any light, but it reaches far into the picture."""
    photo = room()
    photo[HEIGHT // 2 :, :300] = 0
    return photo


def plant() -> Picture:
    """Black leaves at the upper edge: thin, but ragged."""
    photo = room()
    for column, length in enumerate(np.random.default_rng(2).integers(1, 40, 300).tolist(), start=200):
        photo[:length, column] = 0
    return photo


DARK = {
    "a room": lambda: as_jpeg(room()),
    "a cupboard": dark_cupboard,
    "a shadow": deep_shadow,
    "leaves": plant,
    "a covered lens": lambda: np.zeros((HEIGHT, WIDTH, 3), np.uint8),
}


@pytest.mark.parametrize("picture", DARK)
def test_dark_objects_are_not_taken_for_a_black_border(picture: str) -> None:
    assert not border_mask(DARK[picture]()).any()


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


def test_training_sizes_keep_the_aspect_and_are_never_enlarged() -> None:
    assert size_within((640, 480), (320, 320)) == (320, 240)
    assert size_within((480, 640), (320, 320)) == (240, 320)
    assert size_within((100, 50), (320, 320)) == (100, 50)
    assert size_within((5000, 3), (100, 100)) == (100, 1)


CAMERA = Camera(4, 3, 1.0, 1.0, 2.0, 1.5, np.eye(4))
FRAMES = [
    Frame(f"{number}", CAMERA, False, Path("x.png"), None, lambda size: np.zeros((3, 4, 3), np.uint8), None, None)
    for number in range(20)
]


def test_frames_are_read_only_a_few_ahead() -> None:
    begun: list[str] = []

    def read(frame: Frame) -> str:
        begun.append(frame.name)
        return frame.name

    reading = read_ahead(FRAMES, read)
    assert next(reading) == "0"
    assert len(begun) <= MAKERS + 1
    reading.close()  # type: ignore[attr-defined]
    assert len(begun) <= MAKERS + 1


def test_a_bad_frame_is_reported_when_reading_reaches_it() -> None:
    def read(frame: Frame) -> str:
        if frame.name == "7":
            raise PlgsError("made-up", "it is bad", frame.colour_path, "Mend it.")
        return frame.name

    reading = read_ahead(FRAMES, read)
    assert [next(reading) for _ in range(7)] == [str(number) for number in range(7)]
    with raises_key("made-up"):
        next(reading)


def test_frames_in_one_file_are_read_by_one_thread() -> None:
    frames = [replace(frame, file_shows_colour=False) for frame in FRAMES]
    assert set(read_ahead(frames, lambda frame: threading.get_ident())) == {threading.get_ident()}


def test_a_view_sees_points_at_the_depth_it_shows(folder: Path) -> None:
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


def test_views_are_read_back_as_stored(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "scene", frames=3, size=(32, 24)))
    views = [load_view(frame) for frame in scene.frames]
    views[1] = replace(views[1], border=views[1].depth > 2.0)
    told: list[int] = []
    there = StoredViews(iter(views), tmp_path, told.append)
    assert told == [1, 2, 3] and len(there) == 3
    for one, two in zip(there, views, strict=True):
        assert one.name == two.name and one.camera is two.camera and one.mask.segments == two.mask.segments
        for array, other in ((one.colour, two.colour), (one.depth, two.depth), (one.mask.ids, two.mask.ids)):
            assert array.dtype == other.dtype and (array == other).all()
        assert (one.border is None) == (two.border is None)
    assert there[1].border is not None and (there[1].border == views[1].border).all()


def test_a_views_resolution_is_that_of_its_stored_masks(tmp_path) -> None:
    frame = open_scene(write_tiny_scene(tmp_path / "scene", frames=2)).train_frames[0]
    whole, half = load_view(frame), load_view(frame, (frame.size[0] // 2, frame.size[1] // 2))
    assert (whole.mask_scale, half.mask_scale) == (1.0, 2.0)
    expected = 0.01 * np.sqrt(frame.camera.fx * frame.camera.fy) / whole.depth
    np.testing.assert_allclose(resolution_of(whole)[whole.depth > 0], expected[whole.depth > 0], rtol=1e-5)
    assert not resolution_of(whole)[whole.depth <= 0].any()
    known = half.depth > 0
    np.testing.assert_allclose(resolution_of(half)[known], 0.01 * frame.camera.fx / half.depth[known], rtol=0.05)
