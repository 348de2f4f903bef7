"""A mesh.ply of two squares, as the engine exports it."""

from pathlib import Path

import numpy as np
import pytest

from engine.passes.ply import write_ply_table
from tests.tiny_scene import CHAIR_ID, FLOOR_ID

SIDE = 8
"""Points along each side of a square."""


def write_surface(path: Path, shade: int | None = None) -> None:
    """A floor of 4 by 3 m below a 1 by 1 m patch, the chair. ``shade``: each has a picture, shaded left and white
    right."""
    floor, chair = net((0.0, 0.0, 0.0), (4.0, 3.0)), net((1.0, 1.0, 0.5), (1.0, 1.0))
    xyz = np.concatenate([floor, chair])
    triangles = np.concatenate([net_triangles(), net_triangles() + len(floor)])
    part = np.repeat([0, 1], [len(floor), len(chair)])
    columns = {axis: xyz[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns |= {f"n{axis}": np.full(len(xyz), axis == "z", np.float32) for axis in "xyz"}
    columns |= {name: np.full(len(xyz), value, np.uint8) for name, value in (("red", 255), ("green", 128), ("blue", 0))}
    columns["class_id"] = np.where(part == 0, FLOOR_ID, CHAIR_ID).astype(np.int32)
    columns["instance_id"] = part.astype(np.int32)
    path.parent.mkdir(parents=True, exist_ok=True)
    if shade is None:
        return write_ply_table(path, columns, triangles)
    uv = np.concatenate([(floor / (4, 3, 1))[:, :2], (chair - (1, 1, 0))[:, :2]])[triangles].astype(np.float32)
    write_ply_table(path, columns, triangles, uv=uv)
    picture = np.full((32, 64, 3), 255, np.uint8)
    pytest.importorskip("scipy")  # the next Blender's Python has nothing that encodes pictures
    from engine.export.texture import jpeg_bytes

    picture[:, :32] = shade
    for name in (f"{FLOOR_ID}_0", f"{CHAIR_ID}_1"):
        (path.parent / "pictures").mkdir(exist_ok=True)
        (path.parent / "pictures" / f"{name}.jpg").write_bytes(jpeg_bytes(picture))
    return None


def net(corner: tuple[float, float, float], size: tuple[float, float]) -> np.ndarray:
    """SIDE x SIDE points, float64 [N, 3]."""
    x, y = np.meshgrid(np.linspace(0, size[0], SIDE), np.linspace(0, size[1], SIDE))
    return np.stack([x.ravel(), y.ravel(), np.zeros(SIDE * SIDE)], axis=1) + corner


def net_triangles() -> np.ndarray:
    first = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    lower = np.stack([first, first + 1, first + SIDE], axis=1)
    return np.concatenate([lower, np.stack([first + 1, first + SIDE + 1, first + SIDE], axis=1)])
