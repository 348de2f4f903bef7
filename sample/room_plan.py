"""The sample room: its classes, its furniture, and the camera's walk through it.

The house is one open floor of 19 x 11 m. The dining table with its chairs, a chandelier and a few more pieces are moved
next to the sofa, so that they make one room. Everything else stays where it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scene_files import pose_towards

CATEGORIES: tuple[tuple[int, str, bool], ...] = (
    (1, "wall", False),
    (2, "floor", False),
    (3, "ceiling", False),
    (4, "window", False),
    (5, "door", False),
    (6, "rug", False),
    (7, "chair", True),
    (8, "sofa", True),
    (9, "table", True),
    (10, "cabinet", True),
    (11, "shelf", True),
    (12, "bed", True),
    (13, "television", True),
    (14, "lamp", True),
    (15, "picture", True),
    (16, "bin", True),
    (17, "appliance", True),
    (18, "object", True),
)
"""(id, name, is thing). No frame shows the bed, but networks have such a class and sometimes see it."""

CLASS_OF_MODEL: dict[str, str] = {
    "HouseWallB": "wall", "RoomWall": "wall", "FloorB": "floor", "RoomCeiling": "ceiling", "RoomWindow": "window",
    "Curtain": "window", "Door": "door", "FoldingDoor": "door", "Handle": "door", "Carpet": "rug", "ChairA": "chair",
    "ChairD": "chair", "SofaC": "sofa", "KitchenTable": "table", "CoffeeTable": "table", "BalconyTable": "table",
    "ReadingDesk": "table", "TVCabinet": "cabinet", "KitchenCabinet": "cabinet", "Wardrobe": "cabinet",
    "NightStand": "cabinet", "Board": "shelf", "ShoeRack": "shelf", "Bed": "bed", "TV": "television",
    "Chandelier": "lamp", "LightC": "lamp", "PortraitA": "picture", "PortraitB": "picture", "PortraitC": "picture",
    "PortraitD": "picture", "PortraitE": "picture", "Trash": "bin", "AirconditionerA": "appliance",
    "AirconditionerB": "appliance", "Refrigerator": "appliance", "Rangehood": "appliance", "Vase": "object",
    "Tableware": "object", "Tablet": "object", "Dumbbell": "object", "FitnessEquipment": "object",
    "DeskPortraitB": "object",
}  # fmt: skip
"""Class of a model by its "category" property. Models that are missing are in ``STANDS_ON``."""

STANDS_ON: dict[str, str] = {
    "DeskPortraitA_01": "TVCabinet_01_001",
    "DeskPortraitA_02": "CoffeeTable_01_001",
    "DeskPortraitC_01": "NightStand_01_001",
    "DeskPortraitC_02": "CoffeeTable_01_001",
    "DeskPortraitD_01": "Board_01_001",
    "DeskPortraitD_02": "TVCabinet_01_001",
    "DeskPortraitD_03": "CoffeeTable_01_001",
    "DeskPortraitD_04": "ShoeRack_01_001",
    "SecurityCamera_01_001": "TVCabinet_01_001",
    "CookingBench_01_001": "KitchenCabinet_01_001",
    "KitchenUtensils_01_001": "KitchenCabinet_01_001",
    "SeasoningBox_01_001": "KitchenCabinet_01_001",
}
"""Small things, and the larger object that each counts as."""


@dataclass(frozen=True)
class Move:
    """Move an object's origin to ``to`` (x, y, z in metres; None keeps z), and turn it by ``turn`` degrees about z."""

    to: tuple[float, float, float | None]
    turn: float = 0.0


_SET = (-1.9, -3.0)  # the dining set moves as one, chairs and all
MOVES: dict[str, Move] = {
    "KitchenTable_01_001": Move((6.55 + _SET[0], 0.95 + _SET[1], None)),
    "Tableware_01_001": Move((7.15 + _SET[0], 0.98 + _SET[1], None)),
    "ChairA_01_001": Move((7.12 + _SET[0], 0.21 + _SET[1], None)),
    "ChairA_01_002": Move((6.26 + _SET[0], 0.22 + _SET[1], None)),
    "ChairA_01_003": Move((6.07 + _SET[0], 1.68 + _SET[1], None)),
    "ChairA_01_004": Move((7.00 + _SET[0], 1.67 + _SET[1], None)),
    "Vase_01_001": Move((4.25, -2.05, 0.81)),
    "Chandelier_01_003": Move((4.65, -2.05, None)),
    "ChairD_01_001": Move((-0.35, 0.15, None), -50.0),
    "ChairD_01_002": Move((2.95, 0.25, None), 40.0),
    "Trash_01_002": Move((3.55, -4.85, None)),
}

WALK: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    # (eye, target): once around sofa and table, looking in ...
    ((0.2, 1.6, 1.55), (0.7, -2.6, 0.7)),
    ((2.2, 1.7, 1.50), (1.6, -2.6, 0.6)),
    ((4.3, 1.2, 1.55), (3.2, -2.4, 0.6)),
    ((6.1, 0.1, 1.60), (3.8, -2.2, 0.6)),
    ((6.4, -1.9, 1.50), (3.2, -2.1, 0.6)),
    ((5.8, -3.7, 1.45), (2.8, -2.1, 0.6)),
    ((4.2, -4.1, 1.55), (0.6, -2.4, 0.5)),
    ((2.5, -4.2, 1.60), (0.2, -2.2, 0.4)),
    ((0.4, -4.2, 1.65), (0.0, -1.9, 0.3)),
    ((-1.4, -3.8, 1.60), (1.6, -1.9, 0.4)),
    ((-1.8, -2.0, 1.60), (2.3, -2.0, 0.4)),
    ((-1.6, 0.0, 1.60), (1.9, -2.3, 0.4)),
    ((-0.2, 1.2, 1.55), (2.2, -2.2, 0.5)),
    # ... then through the middle, looking around
    ((1.5, 0.9, 1.50), (3.6, -2.3, 0.7)),
    ((2.9, -0.6, 1.45), (4.3, -3.2, 0.7)),
    ((3.0, -1.7, 1.45), (2.9, -5.0, 0.8)),
    ((3.0, -2.7, 1.45), (0.7, -5.3, 0.9)),
    ((2.4, -3.7, 1.50), (-1.2, -4.7, 0.8)),
    ((0.8, -3.9, 1.55), (-2.2, -3.4, 0.8)),
)

STEP_METRES, STEP_DEGREES = 0.8, 15.0
"""The camera moves or turns by this much between two frames. Parts of both add up."""


def _spline(knots: NDArray[np.float64], per_piece: int) -> NDArray[np.float64]:
    """Catmull-Rom curve through ``knots`` float64 [N, D]; returns float64 [(N - 1) * per_piece + 1, D]."""
    ends = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    t = (np.arange(per_piece) / per_piece)[:, None]
    pieces = []
    for a, b, c, d in zip(ends[:-3], ends[1:-2], ends[2:-1], ends[3:], strict=True):
        pieces.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    return np.concatenate([*pieces, knots[-1:]])


def walk(seed: int) -> list[NDArray[np.float64]]:
    """Poses along WALK, float64 [4, 4] camera-to-world, OpenCV axes, with the tremor of a hand drawn from ``seed``."""
    dense = _spline(np.array(WALK).reshape(len(WALK), 6), 100)
    eye, look = dense[:, :3], dense[:, 3:] - dense[:, :3]
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    turned = np.degrees(np.arccos(np.clip((look[1:] * look[:-1]).sum(1), -1, 1)))
    effort = np.linalg.norm(np.diff(eye, axis=0), axis=1) / STEP_METRES + turned / STEP_DEGREES
    travelled = np.concatenate([[0.0], np.cumsum(effort)])
    stops = np.interp(np.arange(0.0, travelled[-1]), travelled, np.arange(len(dense)))
    random = np.random.default_rng(seed)
    poses = []
    for stop in np.round(stops).astype(int):
        position = eye[stop] + random.normal(0, 0.015, 3)
        forward = look[stop] + random.normal(0, 0.012, 3)
        forward /= np.linalg.norm(forward)
        up = np.array([0.0, 0.0, 1.0]) + random.normal(0, 0.015, 3)  # a hand does not hold a phone quite level
        poses.append(pose_towards(position, forward, up))
    return poses
