"""Many points become clouds quickly, and each cloud has its own."""

from __future__ import annotations

import time

import bpy
import numpy as np
import pytest
from plgs.engine.scene import Category, ClassTable
from plgs.plgs_blender.clouds import place_anchors, place_semantic_points
from plgs.plgs_blender.owned import OwnedDataBlocks
from plgs.plgs_blender.results import Anchors, SemanticPoints
from plgs.plgs_blender.surfaces import SurfaceGrid

CLASSES = ClassTable(tuple(Category(k, f"class {k}", k > 3, (10 * k, 250 - 9 * k, 5 * k)) for k in range(1, 22)))


def many_points(count: int) -> SemanticPoints:
    """Points on the faces of a room of 8 x 6 x 2.7 metres, in no order, of 22 classes (0 = unknown) and 60
    instances.
    """
    random = np.random.default_rng(0)
    size = np.array([8.0, 6.0, 2.7])
    face, xyz = random.integers(0, 6, count), random.random((count, 3)) * size
    xyz[np.arange(count), face // 2] = (face % 2) * size[face // 2]
    xyz += random.normal(0.0, 0.004, (count, 3))
    return SemanticPoints(
        xyz.astype(np.float32),
        random.integers(0, 256, (count, 3)).astype(np.uint8),
        random.integers(0, 22, count).astype(np.int32),
        random.integers(0, 60, count).astype(np.int32),
        random.random(count, np.float32),
    )


def place(points: SemanticPoints) -> tuple[list[bpy.types.Object], float]:
    """The clouds, and how many seconds it took to make them and the anchors, a quarter as many."""
    parent = bpy.data.collections.new("points")
    owned = OwnedDataBlocks("lift", bpy.context.scene)
    few = slice(0, len(points.xyz) // 4)
    anchors = Anchors(
        points.xyz[few], points.rgb[few], points.class_id[few], points.instance_id[few],
        points.confidence[few], points.class_id[few] % 4,
    )  # fmt: skip
    viewpoints = np.random.default_rng(1).random((200, 3)) * [6.0, 4.0, 1.0] + 1.0
    started = time.process_time()
    grid = SurfaceGrid.of(points.xyz)
    clouds = place_semantic_points(owned, parent, points, grid, grid.normals(viewpoints), CLASSES)
    place_anchors(owned, parent, anchors)
    return clouds, time.process_time() - started


def read(cloud: bpy.types.Object, name: str, key: str, width: int, dtype: type) -> np.ndarray:
    values = np.zeros(len(cloud.data.points) * width, dtype)
    cloud.data.attributes[name].data.foreach_get(key, values)
    return values.reshape(-1, width)


def test_each_class_has_its_own_points_in_their_order() -> None:
    points = many_points(2000)
    clouds, _ = place(points)
    assert [cloud["class_id"] for cloud in clouds] == list(range(22))
    for cloud in clouds:
        mine = points.class_id == cloud["class_id"]
        assert np.array_equal(read(cloud, "position", "vector", 3, np.float32), points.xyz[mine])
        assert np.array_equal(read(cloud, "instance_id", "value", 1, np.int32)[:, 0], points.instance_id[mine])
        assert np.array_equal(read(cloud, "confidence", "value", 1, np.float32)[:, 0], points.confidence[mine])


def test_no_points_are_no_clouds() -> None:
    assert place(many_points(0))[0] == []


@pytest.mark.parametrize(
    ("count", "most_s"), [(200_000, 0.6), pytest.param(1_000_000, 2.0, marks=pytest.mark.slow)]
)
def test_a_million_points_take_at_most_two_seconds(count: int, most_s: float) -> None:
    """A fifth of them take more than a fifth of the time: some is spent on each class and the room's grid."""
    assert min(place(many_points(count))[1] for _ in range(2)) < most_s
