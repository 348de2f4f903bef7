"""Sequences that hold nothing: what comes back from disk is what went there, bit for bit."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.scene import OnDemand, StoredArrays, StoredViews, chained, load_view, open_scene, stored
from tests.tiny_scene import write_tiny_scene


def test_items_are_made_on_demand() -> None:
    made: list[int] = []

    def make(number: int) -> int:
        made.append(number)
        return 10 * number

    items = OnDemand(4, make)
    assert len(items) == 4 and not made
    assert items[-1] == 30 and made == [3]
    part = items[1:3]
    assert len(part) == 2 and made == [3] and list(part) == [10, 20]
    assert list(items) == [0, 10, 20, 30]
    with pytest.raises(IndexError):
        items[4]


def test_two_sequences_are_one() -> None:
    made: list[int] = []
    first = OnDemand(2, lambda number: made.append(number) or number)  # type: ignore[func-returns-value]
    both = chained(first, "ab")  # type: ignore[misc]
    assert len(both) == 4 and not made
    assert list(both) == [0, 1, "a", "b"] and list(both[1:3]) == [1, "a"] and both[-1] == "b"
    assert list(chained([], [])) == []


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    arrays = [
        np.arange(12, dtype=np.int16).reshape(3, 4)[:, ::2],
        np.array([[np.nan, -0.0]], np.float32),
        np.zeros((0, 3), np.uint8),
        np.array([True, False]),
    ]
    on_disk = stored(arrays, tmp_path)
    assert not list(tmp_path.iterdir()) or sys.platform == "win32", "the file has no name"
    for there, array in reversed(list(zip(on_disk, arrays, strict=True))):
        assert there.dtype == array.dtype and there.shape == array.shape
        assert there.tobytes() == np.ascontiguousarray(array).tobytes()
    arrays_on_disk = StoredArrays(tmp_path)
    first = arrays_on_disk.append(np.arange(1000))
    assert arrays_on_disk[first].sum() == 499_500
    second = arrays_on_disk.append(np.full((7, 7), 3.5))  # after another one was read
    assert (arrays_on_disk[second] == 3.5).all() and (arrays_on_disk[first] == np.arange(1000)).all()


def test_views_come_back_as_they_were(tmp_path: Path) -> None:
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
