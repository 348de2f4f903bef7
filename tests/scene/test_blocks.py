"""Cells cover the world once, and hold about as many points each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import PlgsError
from engine.scene import open_scene
from engine.scene.blocks import cells_of, cut, frames_of, scene_of_block
from tests.tiny_scene import write_tiny_scene


def no_progress(done: int, total: int) -> None:
    assert 0 <= done <= total


@given(st.integers(1, 12), st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 5, 300]))
def test_each_point_lies_in_one_cell(blocks: int, seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3)) * [5, 2, 1]
    cells = cut(points, blocks)
    everywhere = np.concatenate([points, random.normal(size=(50, 3)) * 100])
    assert len(cells) == blocks
    assert (np.stack([cell.contains(everywhere) for cell in cells]).sum(0) == 1).all()


@pytest.mark.parametrize("blocks", [2, 3, 5, 8])
def test_cells_have_about_as_many_points(blocks: int) -> None:
    points = np.random.default_rng(0).uniform(size=(4000, 3)) * [9, 3, 1]
    counts = [np.count_nonzero(cell.contains(points)) for cell in cut(points, blocks)]
    assert max(counts) - min(counts) <= 0.02 * len(points)


def test_a_block_has_the_frames_that_see_it(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "room", frames=8))
    cells, seen = cells_of(scene, 2, no_progress)
    blocks = [frames_of(cell, scene.train_frames, seen) for cell in cells]
    assert {frame.name for block in blocks for frame in block} == {frame.name for frame in scene.train_frames}
    for number, frames in enumerate(blocks, start=1):
        block = scene_of_block(scene, 2, number, no_progress)
        assert [frame.name for frame in block.frames] == [frame.name for frame in frames]
        assert not block.test_frames


def test_too_many_blocks_are_refused(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "room", frames=8))
    with pytest.raises(PlgsError, match="too few for 5 blocks"):
        cells_of(scene, 5, no_progress)
