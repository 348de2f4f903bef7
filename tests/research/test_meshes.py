"""The figures of meshes, on a square of triangles for each piece."""

from __future__ import annotations

import numpy as np

from engine.export.fusion import Surface
from engine.export.mesh import MOST_INSTANCES
from engine.result_files import Instance
from research.meshes import mesh_row

SIDE = 6
"""Vertices along a square's side, 0.2 m apart."""


def instance(number: int, yaw: float = 0.0) -> Instance:
    size, rotation = (1.0, 1.0, 0.1), (1.0, 0.0, 0.0, 0.0)
    return Instance(number, f"box {number}", 1, "box", (0, 0, 0), (0.0, 0.0, 0.0), size, yaw, rotation, 3, 1.0, 9, ())


def squares(*starts: float) -> Surface:
    row, column = np.mgrid[:SIDE, :SIDE].reshape(2, -1)
    corner = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)[:-1, :-1].ravel()
    quads = corner[:, None] + np.array([0, 1, SIDE + 1, SIDE])
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    xyz = np.concatenate([np.stack([start + 0.2 * column, 0.2 * row, 0 * row], axis=-1) for start in starts])
    each = [triangles + SIDE * SIDE * place for place in range(len(starts))]
    rgb, normal = np.zeros(xyz.shape, np.uint8), np.zeros(xyz.shape, np.float32)
    return Surface(xyz.astype(np.float32), rgb, normal, np.concatenate(each).astype(np.int64))


def test_a_mesh_that_reaches_beyond_its_box_is_counted() -> None:
    surface = squares(0.0, 5.0, 9.0)
    label = MOST_INSTANCES + np.repeat([3, 3, 4], SIDE * SIDE)
    row = mesh_row("row", surface, label, {3: instance(3), 4: instance(4)})
    named, sides, objects, in_pieces, turns, far, median = row.split("|")[1:-1]
    assert (named.strip(), objects.strip(), far.strip()) == ("row", "2", "1")
    assert (in_pieces.strip(), turns.strip()) == ("3", "12")  # squares have corners
    assert sides.strip() == f"{100 - 100 * 3 * 4 * (SIDE - 1) / (3 * len(surface.triangles)):.2f} %"
    assert float(median) == round((np.hypot(6, 1) / np.sqrt(2.01) + np.sqrt(2 / 2.01)) / 2, 2)


def test_a_turned_box_is_measured_along_its_sides() -> None:
    surface = squares(0.0)
    label = np.full(len(surface.xyz), MOST_INSTANCES + 3)
    median = mesh_row("row", surface, label, {3: instance(3, np.pi / 4)}).split("|")[-2]
    assert float(median) == round(2 / np.sqrt(2.01), 2)
