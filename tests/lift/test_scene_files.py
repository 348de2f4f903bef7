"""What of a lifted scene is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.lift.scene_files import FILLED, is_near_measured, shown_by_depth
from engine.scene import load_view, open_scene
from engine.semantics.point_cloud import SemanticPointCloud
from tests.tiny_scene import write_tiny_scene


def cloud_of(xyz: np.ndarray, spacing: float = 0.025) -> SemanticPointCloud:
    count = len(xyz)
    rgb, ids, one = np.zeros((count, 3), np.uint8), np.zeros(count, np.int32), np.ones(count, np.float32)
    return SemanticPointCloud(xyz.astype(np.float32), rgb, ids, one, one[:, None], (1,), spacing)


def test_places_in_holes_were_not_measured(tmp_path: Path) -> None:
    """Points of two views, of which the second has a hole, and points 40 cm behind those of the first."""
    scene = open_scene(write_tiny_scene(tmp_path, frames=2, size=(80, 60)))
    first, second = (load_view(frame) for frame in scene.frames)
    holed = replace(second, depth=np.where(np.indices(second.depth.shape)[1] < 40, second.depth, np.float32(0)))
    on_it = [view.camera.unproject(view.depth)[::7, ::7].reshape(-1, 3) for view in (first, second)]
    beyond = first.camera.unproject(first.depth + 0.4)[::7, ::7].reshape(-1, 3)
    told: list[tuple[int, int]] = []
    cloud = cloud_of(np.concatenate([on_it[0], beyond]))
    is_shown = shown_by_depth(cloud, [first], lambda *done: told.append(done))
    assert is_shown[: len(on_it[0])].all() and not is_shown[len(on_it[0]) :].any() and told[-1] == (1, 1)
    assert shown_by_depth(cloud_of(on_it[1]), [second], lambda *_: None).all()
    half = shown_by_depth(cloud_of(on_it[1]), [holed], lambda *_: None)
    assert 0.4 < half.mean() < 0.6
    assert shown_by_depth(cloud_of(beyond, spacing=0.5), [first], lambda *_: None).all()  # means of so large cells
    assert not shown_by_depth(cloud, [], lambda *_: None).any()


def test_planes_far_from_what_was_measured_are_not_shown() -> None:
    """A row of points of which the first is measured; an object all of whose points lie far is kept."""
    xyz = np.stack([np.arange(0, 1, 0.1) + 0.01, np.zeros(10), np.zeros(10)], axis=1)
    owner = np.array([0, 0, 1, 1, 1, 1, 0, 0, 2, 2], np.int32)
    seen = is_near_measured(cloud_of(xyz), owner, np.arange(10) == 0)
    assert [*np.flatnonzero(seen)] == [0, 1, 2, 8, 9] and 0.2 < FILLED < 0.31
    assert is_near_measured(cloud_of(xyz), owner, np.zeros(10, np.bool_)).sum() == 6  # the objects
    assert is_near_measured(cloud_of(xyz, spacing=0.5), owner, np.arange(10) == 0).all()  # lie far apart
