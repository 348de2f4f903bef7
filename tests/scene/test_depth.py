"""Depth, measured and estimated, and holes of a sensor, which are filled where a plane surrounds them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.scene import open_scene, open_scene_to_lift
from engine.scene.estimated_depth import fit_depth
from engine.scene.hole_filling import RING, STRETCH, fill_holes
from engine.scene_source import SceneSource
from tests.raises_key import raises_key
from tests.scene.formats.room import Lens, elsewhere, in_steps, look, quaternion, views, write_colour
from tests.scene.refusing import refuses
from tests.tiny_scene import tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene


@pytest.mark.parametrize("none", [0, 65535])
@pytest.mark.parametrize("channels", [1, 3])
def test_missing_depth_stays_missing_at_any_size(tmp_path: Path, none: int, channels: int) -> None:
    """The largest value was 65.5 m: a wall of points around the room. Three equal channels are depth, too."""
    folder = write_tiny_scene(tmp_path, frames=5)
    depth = np.full((48, 64, channels), 2000, np.uint16)
    depth[::2] = none
    cv2.imwrite(str(folder / "depth" / "0001.png"), depth)
    read = open_scene(folder).frames[1].read_depth((100, 75))
    assert {*np.unique(read).tolist()} == {0.0, 2.0}, "holes must not be mixed with depth"


def test_depth_of_another_size_is_fitted_to_the_colour_picture(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5, size=(64, 48), depth_size=(32, 24))
    frame = open_scene(folder).frames[2]
    assert frame.read_depth(None).shape == (24, 32)
    enlarged = frame.read_depth((64, 48))
    traced = trace_view(tiny_pose(2, 5), tiny_intrinsics((64, 48)), (64, 48)).depth
    # Nearest is off by half a coarse pixel at most: less than the same depth moved by one fine pixel more.
    off = np.median(np.abs(enlarged - traced))
    assert off < 0.03
    assert all(off < np.median(np.abs(np.roll(enlarged, shift, axis=0) - traced)) for shift in (-2, -1, 1, 2))


def test_a_separate_depth_lens_is_used(tmp_path: Path) -> None:
    size = (64, 48)
    folder = write_tiny_scene(tmp_path, frames=5, size=size)
    lens = tiny_intrinsics(size)
    lens[0, 0] *= 0.93
    lens[1, 1] *= 0.93
    lens[0, 2] -= 1.5
    traced = trace_view(tiny_pose(2, 5), lens, size).depth
    cv2.imwrite(str(folder / "depth" / "0002.png"), np.round(traced * 1000).astype(np.uint16))
    aside = open_scene(folder).frames[2].read_depth(None)
    lens[:2, 2] -= 0.5
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", lens)
    scene = open_scene(folder)
    assert scene.warnings == ()
    expected = trace_view(tiny_pose(2, 5), tiny_intrinsics(size), size).depth
    read = scene.frames[2].read_depth(None)
    assert np.median(np.abs(read - expected)) < 0.5 * np.median(np.abs(aside - expected))
    assert (read > 0).all(), "a wider depth lens covers the colour picture"


def test_a_depth_lens_equal_but_for_rounding_changes_nothing(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5, depth_size=(32, 24))
    before = open_scene(folder).frames[1].read_depth((64, 48))
    lens = tiny_intrinsics((32, 24))
    lens[:2, 2] -= 0.5
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", lens, fmt="%.3f")
    np.testing.assert_array_equal(open_scene(folder).frames[1].read_depth((64, 48)), before)


@pytest.mark.parametrize("focal", [20.0, 90.0])
def test_an_impossible_depth_lens_is_ignored_with_a_warning(tmp_path: Path, focal: float) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    before = open_scene(folder).frames[1].read_depth(None)
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", [[focal, 0, 32], [0, focal, 24], [0, 0, 1]])
    scene = open_scene(folder)
    assert scene.warnings[0].startswith("intrinsic_depth.txt is ignored")
    np.testing.assert_array_equal(scene.frames[1].read_depth(None), before)


LENS = Lens()
POINTS = 60


@pytest.mark.parametrize("inverse", [False, True])
def test_scale_and_shift_of_depth_are_found_despite_noise(inverse: bool) -> None:
    random = np.random.default_rng(5)
    depths = random.uniform(0.8, 6.0, 300)
    noisy = depths * (1.0 + 0.01 * random.standard_normal(300))
    values = (1.0 / noisy if inverse else noisy) * 37.0 + 5.0
    values[:100] = random.uniform(values.min(), values.max(), 100)
    fit = fit_depth(values, depths)
    assert fit is not None and fit.is_inverse is inverse
    assert fit.scale == pytest.approx(1 / 37, rel=0.02) and fit.shift == pytest.approx(-5 / 37, abs=0.02)
    right = depths[100:]
    assert np.median(np.abs(fit.depth(values[100:]) / right - 1.0)) < 0.01


def write_colmap(folder: Path) -> Path:
    """Points on the room's surfaces, each in the track of the picture that it was taken from."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 PINHOLE 64 48 {LENS.fx} {LENS.fy} {LENS.cx} {LENS.cy}\n")
    images, points = "", ""
    random = np.random.default_rng(2)
    for i, plain in enumerate(views()):
        view, picture = elsewhere(plain), look(plain, LENS)
        write_colour(folder / "images" / f"{i}.png", picture.colour)
        track = ""
        for k in range(POINTS if i else 5):
            column, row = int(random.integers(0, 64)), int(random.integers(0, 48))
            x, y, z = (column + 0.5 - LENS.cx) / LENS.fx, (row + 0.5 - LENS.cy) / LENS.fy, picture.depth[row, column]
            xyz = view.eye + z * (view.forward + x * view.right - y * view.up)
            points += f"{1000 * i + k + 1} {xyz[0]} {xyz[1]} {xyz[2]} 1 2 3 0.1 {i + 1} {k}\n"
            track += f"{column + 0.5} {row + 0.5} {1000 * i + k + 1} "
        rows = np.stack([view.right, -view.up, view.forward])
        q, t = quaternion(rows), -rows @ view.eye
        images += f"{i + 1} {' '.join(map(repr, map(float, (*q, *t))))} 1 {i}.png\n{track}\n"
    (sparse / "images.txt").write_text(images)
    (sparse / "points3D.txt").write_text(points)
    return folder


@pytest.mark.parametrize("kind", ["npy", "png", "three equal channels"])
def test_a_networks_depth_maps_are_fitted_to_colmaps_points(tmp_path: Path, kind: str) -> None:
    """Inverse depth as floats, of another size than the pictures; or depth in steps of its own."""
    write_colmap(tmp_path / "scene")
    (tmp_path / "maps").mkdir()
    for i, view in enumerate(views()):
        if kind == "npy":
            values = 300.0 / look(view, LENS.scaled(2)).depth - 20.0 * i
            np.save(tmp_path / "maps" / f"{i}.npy", values[None].astype(np.float32))
        else:
            steps = in_steps(look(view, LENS).depth, 900 + 100 * i) + 50
            assert cv2.imwrite(str(tmp_path / "maps" / f"{i}.png"), steps if kind == "png" else np.dstack([steps] * 3))
    with raises_key("no-depth --depth"):
        open_scene_to_lift(SceneSource(tmp_path / "scene"))
    scene = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    assert scene.has_depth and [frame.name for frame in scene.frames] == ["1", "2", "3", "4", "5"]
    assert "1 frame without 12 points of the reconstruction in view is left out: 0" in scene.warnings
    for frame, view in zip(scene.frames, views()[1:], strict=True):
        depth = frame.depth()
        off = np.abs(depth / look(view, LENS.scaled(depth.shape[1] / 64)).depth - 1.0)
        assert (depth > 0.0).mean() > 0.99 and np.median(off) < 0.01 and np.quantile(off, 0.9) < 0.03


def test_missing_or_wrong_depth_maps_give_one_line_errors(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene")
    (tmp_path / "maps").mkdir()
    for i in range(2):
        np.save(tmp_path / "maps" / f"{i}.npy", np.ones((48, 64), np.float32))
    refuses("lacks-files", tmp_path / "scene", depth=tmp_path / "maps")
    for i in range(2, 5):
        np.save(tmp_path / "maps" / f"{i}.npy", np.ones((48, 64), np.float32))
    scene = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    assert "1 frame without a readable depth map is left out: 5" in scene.warnings and len(scene.frames) == 4
    np.save(tmp_path / "maps" / "5.npy", np.ones((48, 64), np.float32))
    scene = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    with raises_key("depth-unrelated"):
        scene.frames[0].depth()
    (tmp_path / "scene" / "sparse" / "0" / "points3D.txt").unlink()
    metric = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    assert any("no sparse points" in warning for warning in metric.warnings)
    np.testing.assert_array_equal(metric.frames[0].depth(), np.ones((48, 64), np.float32))


def test_an_8_bit_depth_map_is_never_read_as_millimetres(tmp_path: Path) -> None:
    """Depth Anything's run.py --grayscale: inverse depth from 0 to 255 in three equal channels."""
    write_colmap(tmp_path / "scene")
    (tmp_path / "maps").mkdir()
    for i, view in enumerate(views()):
        near = 1.0 / look(view, LENS).depth
        grey = np.round(near / near.max() * 255).astype(np.uint8)
        assert cv2.imwrite(str(tmp_path / "maps" / f"{i}.png"), np.dstack([grey] * 3))
    frame = open_scene(tmp_path / "scene", depth=tmp_path / "maps").frames[2]
    assert np.median(np.abs(frame.depth() / look(views()[3], LENS).depth - 1.0)) < 0.01
    (tmp_path / "scene" / "sparse" / "0" / "points3D.txt").unlink()
    refuses("depth-bits", tmp_path / "scene", depth=tmp_path / "maps")


HEIGHT, WIDTH = 48, 64
HOLE = (slice(16, 30), slice(20, 44))
WALL, SCREEN = 1, 2


def plane(normal: tuple[float, float, float], metres: float) -> np.ndarray:
    """Depth float64 [H, W] of a plane seen by a camera 60 degrees wide, ``metres`` off along the optical axis."""
    focal = WIDTH / 2 / np.tan(np.radians(30))
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / focal
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / focal
    rays = np.stack([*np.meshgrid(x, y), np.ones((HEIGHT, WIDTH))], axis=-1)
    return metres * normal[2] / (rays @ np.array(normal))


def measured(true: np.ndarray, noise: float = 0.0, hole: tuple[slice, slice] = HOLE) -> np.ndarray:
    """What a sensor says, float32: noise as a share of the depth, and nothing in the hole."""
    depth = true * (1 + noise * np.random.default_rng(0).standard_normal(true.shape))
    depth[hole] = 0
    return depth.astype(np.float32)


ONE_SEGMENT = np.full((HEIGHT, WIDTH), WALL, np.int32)
FLOOR = plane((0.0, 0.9, 0.3), 2.5)
"""Its depth grows from row to row."""
slanting = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.just(1.0))


@settings(max_examples=40, deadline=None)
@given(slanting, st.floats(0.5, 6), st.integers(2, 30), st.integers(2, 30), st.integers(1, 15), st.integers(1, 15))
def test_a_depth_hole_in_a_plane_is_filled(
    normal: tuple[float, float, float], metres: float, top: int, left: int, height: int, width: int
) -> None:
    true = plane(normal, metres)
    hole = (slice(top, top + height), slice(left, left + width))
    filled = fill_holes(measured(true, hole=hole), ONE_SEGMENT)
    assert filled.dtype == np.float32
    np.testing.assert_allclose(filled, true, rtol=1e-3)


def test_noise_and_outliers_do_not_move_a_filled_depth_hole() -> None:
    true = plane((0.2, 0.3, 1.0), 3.0)
    depth = measured(true, noise=0.005)
    flying = np.random.default_rng(1).random(depth.shape) < 0.04
    depth[flying & (depth > 0)] *= 0.6
    filled = fill_holes(depth, ONE_SEGMENT)
    np.testing.assert_allclose(filled[HOLE], true[HOLE], rtol=0.01)


def test_a_depth_hole_between_two_depths_is_not_filled() -> None:
    """A gap between a chair and the wall far behind it: no plane goes through both."""
    true = np.where(np.arange(WIDTH) < 32, 1.5, 4.0) * np.ones((HEIGHT, 1))
    depth = measured(true, hole=(slice(10, 30), slice(26, 38)))
    np.testing.assert_array_equal(fill_holes(depth, ONE_SEGMENT), depth)


def test_depth_holes_are_filled_only_within_their_segment() -> None:
    """Half of the hole is the wall's, half a near box's: each is filled from its own ring."""
    segments = np.where(np.arange(WIDTH) < 32, WALL, SCREEN).astype(np.int32) * np.ones((HEIGHT, 1), np.int32)
    true = np.where(segments == WALL, FLOOR, 1.0)
    np.testing.assert_allclose(fill_holes(measured(true), segments), true, rtol=1e-3)


def test_a_segment_without_depth_takes_depth_of_its_surroundings() -> None:
    """A screen on a wall: black, so the sensor sees nothing of it."""
    segments = ONE_SEGMENT.copy()
    segments[HOLE] = SCREEN
    true = plane((0.3, 0.0, 1.0), 2.0)
    np.testing.assert_allclose(fill_holes(measured(true), segments), true, rtol=1e-3)


def test_a_depth_hole_without_surroundings_is_not_filled() -> None:
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    assert not fill_holes(depth, ONE_SEGMENT).any()
    depth[20, 20:25] = 2.0  # too few to say what plane it is
    np.testing.assert_array_equal(fill_holes(depth, ONE_SEGMENT), depth)
    whole = FLOOR.astype(np.float32)
    np.testing.assert_array_equal(fill_holes(whole, ONE_SEGMENT), whole)


def test_depth_holes_are_not_filled_far_from_measured_depth() -> None:
    """The upper half of the picture, towards the horizon of a floor."""
    rows = slice(0, 24)
    focal = WIDTH / 2 / np.tan(np.radians(30))
    below = (np.arange(HEIGHT) + 0.5 - 20) / focal  # the horizon is at row 20
    true = np.where(below > 0, 1.5 / np.maximum(below, 1e-9), 0)[:, None] * np.ones((1, WIDTH))
    depth = measured(true, hole=(rows, slice(None)))
    filled = fill_holes(depth, ONE_SEGMENT)
    ring = depth[24 : 24 + RING]
    assert filled[:20].max() == 0, "above the horizon there is no floor"
    assert 0 < filled[rows].max() <= STRETCH * ring.max()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 0.9))
def test_filling_depth_holes_changes_no_measured_pixel(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    segments = np.kron(random.integers(0, 3, (4, 4)), np.ones((8, 8))).astype(np.int32)
    depth = random.uniform(0.5, 4, 4)[random.integers(0, 4, (4, 4))].repeat(8, 0).repeat(8, 1).astype(np.float32)
    depth *= random.uniform(0.98, 1.02, depth.shape).astype(np.float32)
    depth[random.random(depth.shape) < share] = 0
    before = depth.copy()
    filled = fill_holes(depth, segments)
    np.testing.assert_array_equal(depth, before)
    np.testing.assert_array_equal(filled[before > 0], before[before > 0])
    assert np.isfinite(filled).all() and (filled >= 0).all()
    known = before[before > 0]
    if len(known):
        assert filled.max() <= STRETCH * known.max() * 1.001


def test_thousands_of_small_depth_holes_are_filled() -> None:
    """With the mean around them: near, if not exact."""
    true = plane((0.1, 0.1, 1.0), 3.0)
    depth = measured(true)
    depth[np.random.default_rng(0).random(depth.shape) < 0.08] = 0
    specks = fill_holes(depth, ONE_SEGMENT)
    assert (specks > 0).all()
    np.testing.assert_allclose(specks, true, rtol=0.02)
