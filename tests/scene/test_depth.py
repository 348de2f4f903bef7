from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.tiny_scene import tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene


def test_depth_is_metres_as_it_was_traced(tmp_path: Path) -> None:
    frame = open_scene(write_tiny_scene(tmp_path, frames=5)).frames[2]
    depth = frame.read_depth(None)
    assert depth.dtype == np.float32
    traced = trace_view(tiny_pose(2, 5), tiny_intrinsics((64, 48)), (64, 48)).depth
    np.testing.assert_allclose(depth, traced, atol=0.00051)


def test_no_depth_stays_none_at_any_size(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    depth = np.full((48, 64), 2000, np.uint16)
    depth[::2] = 0
    cv2.imwrite(str(folder / "depth" / "0001.png"), depth)
    read = open_scene(folder).frames[1].read_depth((100, 75))
    assert {*np.unique(read).tolist()} == {0.0, 2.0}, "holes must not be mixed with depth"


def test_the_largest_value_is_no_depth(tmp_path: Path) -> None:
    """It was 65.5 m: a wall of points around the room, without a word."""
    scene = write_tiny_scene(tmp_path)
    path = scene / "depth" / "0000.png"
    steps = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    steps[:5] = 65535
    cv2.imwrite(str(path), steps)
    depth = open_scene(scene).frames[0].depth()
    assert not depth[:5].any() and depth[5:].all()


def test_grey_in_three_equal_channels_is_depth(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5)
    cv2.imwrite(str(folder / "depth" / "0001.png"), np.full((48, 64, 3), 1999, np.uint16))
    np.testing.assert_allclose(open_scene(folder).frames[1].depth(), 1.999)


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
