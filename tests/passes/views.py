"""A rendering made by hand: a wall, two chairs and a corner where nothing was rendered."""

import numpy as np

from engine.model.neural_gaussians import PanopticRendering
from engine.scene import Camera, Category, ClassTable

WALL, CHAIR, SOFA = 1, 5, 6
CLASSES = ClassTable(
    (
        Category(WALL, "wall", False, (120, 130, 140)),
        Category(CHAIR, "chair", True, (210, 70, 60)),
        Category(SOFA, "sofa, long", True, (60, 110, 200)),
    )
)
NAMES = {3: "chair 1", 70001: "chair 2"}
HEIGHT, WIDTH = 6, 8
# [rows, columns] of the picture: left chair, edge of the left chair, right chair, nothing
LEFT, EDGE = (slice(0, 6), slice(0, 2)), (slice(0, 6), slice(2, 3))
RIGHT, NOTHING = (slice(0, 6), slice(5, 7)), (slice(0, 6), slice(7, 8))


def made_rendering() -> PanopticRendering:
    """Columns 0-1 chair 3, column 2 chair 3 at 60 % before the wall, 3-4 wall, 5-6 chair 70001, 7 nothing."""
    alpha = np.ones((HEIGHT, WIDTH), np.float32)
    classes = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    slots = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    classes[..., 0] = 1.0
    slots[..., 1] = 1.0  # the wall has an idea of an instance too
    classes[LEFT], slots[LEFT] = (0, 1, 0), (1, 0)
    classes[EDGE], slots[EDGE] = (0.4, 0.6, 0), (0.7, 0.3)
    classes[RIGHT], slots[RIGHT] = (0, 0.75, 0.25), (0, 1)
    alpha[NOTHING], classes[NOTHING], slots[NOTHING] = 0, 0, 0
    image = np.broadcast_to(np.array([0.5, 0.25, 1.0], np.float32), (HEIGHT, WIDTH, 3)) * alpha[..., None]
    return PanopticRendering(
        camera=Camera(WIDTH, HEIGHT, 8.0, 8.0, 4.0, 3.0, np.eye(4)),
        image=image.astype(np.float32),
        alpha=alpha,
        depth=alpha * 2.5,
        class_coverage=classes,
        instance_coverage=slots,
        class_ids=(WALL, CHAIR, SOFA),
        instance_ids=(3, 70001),
    )
