"""Views of a wall at y = 3 m, looking along +y, by hand: what the tests of labels in space share."""

import numpy as np

from engine.scene import Camera, PanopticMask, Segment, View

WALL, FLOOR, CHAIR, SOFA = 1, 2, 5, 6
CLASS_IDS = (WALL, FLOOR, CHAIR, SOFA)
SIZE = (40, 30)


def wall_view(name: str, x: float, depth: np.ndarray | float = 3.0, classes: np.ndarray | int = WALL) -> View:
    """A camera at (x, 0, 1); ``depth`` and ``classes`` by pixel or one for all. Segment id = class id."""
    width, height = SIZE
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = x, 0.0, 1.0
    camera = Camera(width, height, 40.0, 40.0, width / 2, height / 2, pose)
    ids = np.broadcast_to(np.asarray(classes, np.int32), (height, width)).copy()
    segments = tuple(Segment(int(i), int(i), int(i) >= CHAIR) for i in np.unique(ids) if i)
    metres = np.broadcast_to(np.asarray(depth, np.float32), (height, width)).copy()
    return View(name, camera, np.full((height, width, 3), 128, np.uint8), metres, PanopticMask(ids, segments))


def square(inside: float, outside: float, columns: slice, rows: slice = slice(10, 20)) -> np.ndarray:
    """A picture of ``outside`` with a rectangle of ``inside``."""
    width, height = SIZE
    picture = np.full((height, width), outside)
    picture[rows, columns] = inside
    return picture
