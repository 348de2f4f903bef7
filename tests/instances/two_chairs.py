"""A ray-traced floor and back wall with boxes for chairs, seen from where a test likes."""

import cv2
import numpy as np

from engine.scene import Camera, PanopticMask, Segment, View
from tests.tiny_scene import looking_at

WALL, CHAIR, SOFA = 1, 5, 6
THINGS = frozenset({CHAIR, SOFA})
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def look(eye: tuple[float, float, float], target: tuple[float, float, float], size: tuple[int, int]) -> Camera:
    """A camera 60 degrees wide at ``eye``."""
    pose = looking_at(np.array(target), np.array(eye))
    width, height = size
    focal = width / 2 / np.tan(np.radians(30))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def view_of(name: str, camera: Camera, boxes: list[Box], bleed: int = 0, scores: float = 0.9) -> View:
    """Depth of a 10 m room with ``boxes``; segment i + 2 is box i (a chair), 1 all else; masks grown by ``bleed``."""
    rays = camera.unproject(np.ones((camera.height, camera.width), np.float32)) - camera.centre
    best, ids = _exit(rays, camera.centre), np.ones(rays.shape[:2], np.int32)
    for i, (low, high) in enumerate(boxes):
        with np.errstate(divide="ignore"):
            first, second = (np.array(low) - camera.centre) / rays, (np.array(high) - camera.centre) / rays
        near, far = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
        hit = (near <= far) & (near > 0) & (near < best)
        best, ids = np.where(hit, near, best), np.where(hit, i + 2, ids)
    true = ids.copy()
    for i in range(len(boxes) if bleed else 0):
        grown = cv2.dilate((true == i + 2).astype(np.uint8), np.ones((3, 3), np.uint8), iterations=bleed)
        ids[(grown > 0) & (true == 1)] = i + 2
    present = [i for i in range(2, len(boxes) + 2) if (ids == i).any()]
    segments = (Segment(1, WALL, False), *(Segment(i, CHAIR, True, scores) for i in present))
    colour = np.zeros((camera.height, camera.width, 3), np.uint8)
    return View(name, camera, colour, best.astype(np.float32), PanopticMask(ids.astype(np.int32), segments))


def _exit(rays: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Depth at which rays leave the room x, y -5..5, z 0..3."""
    with np.errstate(divide="ignore"):
        walls = np.where(rays > 0, [5.0, 5.0, 3.0], [-5.0, -5.0, 0.0]) - centre
        return np.where(rays != 0, walls / rays, np.inf).min(-1)
