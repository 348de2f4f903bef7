"""A result made by hand: two chairs that are one object, a table, crumbs on the table, and the floor."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine import result_files
from engine.scene import Category, ClassTable

FLOOR, CHAIR, TABLE, SOFA = 1, 2, 3, 4
CLASSES = ClassTable(
    (
        Category(FLOOR, "floor", False, (90, 90, 90)),
        Category(CHAIR, "chair", True, (200, 40, 40)),
        Category(TABLE, "table", True, (40, 200, 40)),
        Category(SOFA, "sofa", True, (40, 40, 200)),
    )
)
CHAIRS, DESK, CRUMB = 1, 2, 3


def block(low: tuple[float, float, float], high: tuple[float, float, float], step: float = 0.05) -> NDArray[np.float32]:
    """Points of a grid, float32 [N, 3]."""
    axes = [np.arange(a, b + 1e-6, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def write_result(lift: Path, shift: float = 0.0, without: int = 0) -> Path:
    """Write the result into a lift folder, its points shifted by metres, and ``without`` one object."""
    parts = [
        (FLOOR, 0, block((-1, -1, 0), (4, 2, 0), 0.1)),
        (CHAIR, CHAIRS, np.concatenate([block((0, 0, 0.1), (0.4, 0.4, 0.8)), block((1, 0, 0.1), (1.4, 0.4, 0.8))])),
        (TABLE, DESK, block((2, 0, 0.7), (3.2, 0.8, 0.75))),
        (TABLE, CRUMB, block((2.4, 0.3, 0.8), (2.6, 0.5, 0.85))),
    ]
    parts = [part for part in parts if part[1] != without or not part[1]]
    xyz = np.concatenate([points for _, _, points in parts]) + np.float32(shift)
    class_id = np.concatenate([np.full(len(points), one, np.int32) for one, _, points in parts])
    instance_id = np.concatenate([np.full(len(points), one, np.int32) for _, one, points in parts])
    count = len(xyz)
    rgb, full = np.full((count, 3), 128, np.uint8), np.ones(count, np.float32)
    result_files.write_arrays(
        lift / "result" / result_files.SEMANTIC_POINTS,
        result_files.SemanticPoints(xyz, rgb, class_id, instance_id, full),
    )
    few = slice(None, None, 3)
    anchors = result_files.Anchors(xyz[few] + 0.01, class_id[few], instance_id[few], full[few], class_id[few], rgb[few])
    result_files.write_arrays(lift / "result" / result_files.ANCHORS, anchors)
    names = {CHAIRS: "chair 1", DESK: "table 1", CRUMB: "table 2"}
    instances = [
        result_files.Instance(
            one, names[one], kind, CLASSES[kind].name, (10, 20, 30), tuple(points.mean(axis=0).tolist()),
            tuple(np.ptp(points, axis=0).tolist()), 0.0, (1.0, 0.0, 0.0, 0.0), 5, 0.9, len(points), (),
        )
        for kind, one, points in parts if one
    ]  # fmt: skip
    result_files.write_instances(lift / "result" / result_files.INSTANCES, CLASSES, instances)
    return lift
