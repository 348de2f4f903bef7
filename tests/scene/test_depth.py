"""Depth, measured and estimated."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene, open_scene_to_lift
from engine.scene.estimated_depth import fit_depth
from engine.scene_source import SceneSource
from tests.raises_key import raises_key
from tests.scene.formats.room import Lens, elsewhere, in_steps, look, quaternion, views, write_colour
from tests.scene.refusing import refuses
from tests.tiny_scene import tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene


@pytest.mark.parametrize("none", [0, 65535])
@pytest.mark.parametrize("channels", [1, 3])
def test_no_depth_stays_none_at_any_size(tmp_path: Path, none: int, channels: int) -> None:
    """The largest value was 65.5 m: a wall of points around the room. Three equal channels are depth, too."""
    folder = write_tiny_scene(tmp_path, frames=5)
    depth = np.full((48, 64, channels), 2000, np.uint16)
    depth[::2] = none
    cv2.imwrite(str(folder / "depth" / "0001.png"), depth)
    read = open_scene(folder).frames[1].read_depth((100, 75))
    assert {*np.unique(read).tolist()} == {0.0, 2.0}, "holes must not be mixed with depth"


def test_depth_of_another_size_fits_the_colour(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5, size=(64, 48), depth_size=(32, 24))
    frame = open_scene(folder).frames[2]
    assert frame.read_depth(None).shape == (24, 32)
    enlarged = frame.read_depth((64, 48))
    traced = trace_view(tiny_pose(2, 5), tiny_intrinsics((64, 48)), (64, 48)).depth
    # Nearest is off by half a coarse pixel at most: less than the same depth moved by one fine pixel more.
    off = np.median(np.abs(enlarged - traced))
    assert off < 0.03
    assert all(off < np.median(np.abs(np.roll(enlarged, shift, axis=0) - traced)) for shift in (-2, -1, 1, 2))


def test_a_depth_lens_of_its_own_is_honoured(tmp_path: Path) -> None:
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


def test_the_same_lens_in_other_digits_changes_nothing(tmp_path: Path) -> None:
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
def test_scale_and_shift_come_back_through_noise_and_wrong_points(inverse: bool) -> None:
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
def test_colmap_with_a_networks_maps(tmp_path: Path, kind: str) -> None:
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


FLAT = np.full((48, 64), 2.0, np.float32)


def test_missing_and_wrong_maps_are_one_line_errors(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene")
    (tmp_path / "maps").mkdir()
    for i in range(2):
        np.save(tmp_path / "maps" / f"{i}.npy", FLAT)
    refuses("lacks-files", tmp_path / "scene", depth=tmp_path / "maps")
    for i in range(2, 5):
        np.save(tmp_path / "maps" / f"{i}.npy", FLAT)
    scene = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    assert "1 frame without a readable depth map is left out: 5" in scene.warnings and len(scene.frames) == 4
    np.save(tmp_path / "maps" / "5.npy", FLAT)
    scene = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    with raises_key("depth-unrelated"):
        scene.frames[0].depth()
    (tmp_path / "scene" / "sparse" / "0" / "points3D.txt").unlink()
    metric = open_scene(tmp_path / "scene", depth=tmp_path / "maps")
    assert any("no sparse points" in warning for warning in metric.warnings)
    np.testing.assert_array_equal(metric.frames[0].depth(), FLAT)


def test_an_8_bit_map_is_fitted_or_refused_and_never_read_as_millimetres(tmp_path: Path) -> None:
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
