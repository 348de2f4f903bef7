"""Points become clouds, each class its own, and many points take no more lines of Python than few."""

from __future__ import annotations

import bpy
import numpy as np
from plgs.engine.result_files import Anchors, SemanticPoints
from plgs.engine.scene import Category, ClassTable
from plgs.plgs_blender.clouds import SurfaceGrid, place_anchors, place_semantic_points
from plgs.plgs_blender.owned import OwnedDataBlocks

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


def place(points: SemanticPoints) -> list[bpy.types.Object]:
    """The clouds; anchors are made as well, a quarter as many."""
    parent = bpy.data.collections.new("points")
    owned = OwnedDataBlocks("lift", bpy.context.scene)
    few = slice(0, len(points.xyz) // 4)
    anchors = Anchors(
        points.xyz[few], points.class_id[few], points.instance_id[few], points.confidence[few],
        points.class_id[few] % 4, points.rgb[few],
    )  # fmt: skip
    viewpoints = np.random.default_rng(1).random((200, 3)) * [6.0, 4.0, 1.0] + 1.0
    grid = SurfaceGrid.of(points.xyz)
    clouds = place_semantic_points(owned, parent, points, grid, grid.normals(viewpoints), CLASSES)
    place_anchors(owned, parent, anchors)
    return clouds


def read(cloud: bpy.types.Object, name: str, key: str, width: int, dtype: type) -> np.ndarray:
    values = np.zeros(len(cloud.data.points) * width, dtype)
    cloud.data.attributes[name].data.foreach_get(key, values)
    return values.reshape(-1, width)


def test_each_class_has_its_own_points_in_their_order() -> None:
    points = many_points(2000)
    clouds = place(points)
    assert [cloud["class_id"] for cloud in clouds] == list(range(22))
    for cloud in clouds:
        mine = points.class_id == cloud["class_id"]
        assert np.array_equal(read(cloud, "position", "vector", 3, np.float32), points.xyz[mine])
        assert np.array_equal(read(cloud, "instance_id", "value", 1, np.int32)[:, 0], points.instance_id[mine])
        assert np.array_equal(read(cloud, "confidence", "value", 1, np.float32)[:, 0], points.confidence[mine])
