"""The sample with depth as a network would have made it, fitted to points as COLMAP finds them."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from engine.depth_agreement import Map, agreeing_depth
from engine.scene import Frame, open_scene

ROOM = Path(__file__).resolve().parents[2] / "sample" / "room"


def bent(depth: np.ndarray, seed: int) -> np.ndarray:
    """What a network says of true ``depth``: affine in disparity, with a smooth drift of 10 %, blurred jumps, and a
    mirror in which the room goes on."""
    random, (height, width) = np.random.default_rng(seed), depth.shape
    whole = np.where(depth > 0, depth, np.median(depth[depth > 0]))
    coarse = random.uniform(-0.1, 0.1, (3, 4)).astype(np.float32)
    drift = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    disparity = cv2.GaussianBlur((1.0 / (whole * np.exp(drift))).astype(np.float32), (0, 0), width / 200)
    x, y = random.integers(0, width * 3 // 4), random.integers(0, height * 3 // 4)
    disparity[y : y + height // 5, x : x + width // 6] *= 0.5
    return (disparity * random.uniform(5, 30) + random.uniform(1, 4)).astype(np.float32)


def fitted(frames: list[Frame]) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yields each frame's name, its depth after the fit, and its true depth. Each has 250 points, 12 of them false."""
    maps, truth = {}, {}
    for frame in frames:
        random, depth = np.random.default_rng(int(frame.name)), frame.depth(frame.size)
        rows, columns = np.nonzero(depth > 0)
        chosen = random.choice(len(rows), 250, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        known = depth[rows, columns] * (1 + 0.005 * random.standard_normal(250))
        known[:12] *= random.uniform(0.5, 2, 12)  # matched wrongly
        places = np.stack([(columns + 0.5) / depth.shape[1], (rows + 0.5) / depth.shape[0]], axis=-1)
        values = bent(depth, int(frame.name))
        maps[frame.name] = Map(frame.camera, lambda values=values: values, places, known)
        truth[frame.name] = depth
    for name, depth in agreeing_depth(maps):
        assert depth is not None
        yield name, depth, truth[name]


def write_bent_room(folder: Path) -> Path:
    """The sample with such depth in place of the sensor's."""
    shutil.copytree(ROOM, folder)
    for name, depth, _ in fitted([*open_scene(ROOM).frames]):
        cv2.imwrite(str(folder / "depth" / f"{name}.png"), (depth * 1000).round().astype(np.uint16))
    return folder
