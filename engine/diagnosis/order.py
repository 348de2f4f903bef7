"""Are the frames in the order of their recording, and does any frame occur twice?"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..posed.layout import listed
from ..scene import Frame, Scene
from .findings import Finding
from .looks import Floats
from .pictures import scatter, side_by_side
from .reprojection import Assumption, assumed_poses

_FEWEST, _MOST = 12, 1500
"""Frames whose order can be measured. The distances between all of them are computed."""
_REACH = 2.0
"""Metres to what a camera looks at. Steps between frames are measured there, so that turns count."""


class FrameOrder(NamedTuple):
    """Steps between successive frames: the metres by which the place that they look at moves.

    ``given`` is the median step in the order of the names, ``shortest`` the median step of ``path``: an order found by
    always going to the nearest frame. ``rank`` is the median share of all frames that are nearer to a frame than its
    successor. ``smoothness`` is the median cosine between successive steps of ``path``: 1 if straight, 0 if random.
    """

    given: float
    shortest: float
    rank: float
    smoothness: float
    path: tuple[int, ...]

    @property
    def is_shuffled(self) -> bool:
        """Whether a smooth recording was shuffled. Views from random places have no smooth path through them."""
        return self.rank > 1 / 6 and self.shortest * 4.0 < self.given and self.smoothness > 0.5


def measure_order(scene: Scene, assumed: Assumption) -> FrameOrder | None:
    """The order of all frames under an assumption. None where there are too few or too many."""
    count = len(scene.frames)
    if not _FEWEST <= count <= _MOST:
        return None
    turn = np.eye(3) if scene.turn is None else scene.turn
    poses = assumed_poses(np.stack([frame.camera.camera_to_world for frame in scene.frames]), turn, assumed)
    places = np.concatenate([poses[:, :3, 3] + _REACH * poses[:, :3, 2], poses[:, :3, 3]], axis=1)
    squares = (places**2).sum(1)
    distances = np.sqrt(np.maximum(squares[:, None] + squares[None] - 2.0 * places @ places.T, 0.0) / 2.0)
    np.fill_diagonal(distances, np.inf)
    steps = distances[np.arange(count - 1), np.arange(1, count)]
    nearer = (distances[:-1] < steps[:, None]).sum(1)
    # The second walk begins at an end of the recording: the last frame of a walk from anywhere.
    path = _walk(distances, _walk(distances, 0)[-1])
    return FrameOrder(
        given=float(np.median(steps)),
        shortest=float(np.median(distances[path[:-1], path[1:]])),
        rank=float(np.median(nearer)) / count,
        smoothness=_smoothness(places[path]),
        path=tuple(path),
    )


def _walk(distances: Floats, start: int) -> list[int]:
    """The order of a walk from each frame to the nearest one that is left."""
    left = distances.copy()
    path = [start]
    for _ in range(len(distances) - 1):
        left[:, path[-1]] = np.inf
        path.append(int(left[path[-1]].argmin()))
    return path


def _smoothness(places: Floats) -> float:
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    moving = (lengths[1:] > 1e-9) & (lengths[:-1] > 1e-9)
    cosines = (steps[1:] * steps[:-1]).sum(1)[moving] / (lengths[1:] * lengths[:-1])[moving]
    return float(np.median(cosines)) if len(cosines) else 0.0


def order_findings(scene: Scene, order: FrameOrder | None) -> list[Finding]:
    """Whether the frames are not in the order of their recording."""
    if order is None or not order.is_shuffled:
        return []
    best = listed([scene.frames[number].name for number in order.path], 6)
    places = np.arange(len(order.path), dtype=np.float64)
    return [
        Finding(
            cause="unsorted frames",
            severity="wrong",
            text=f"frames are not in the order of the recording: what the cameras look at moves by {order.given:.2f} m "
            f"from one frame to the next, and by {order.shortest:.2f} m in the order {best}",
            option="name the files in the order of the recording",
            figures={"step_m": order.given, "shortest_step_m": order.shortest, "nearer_share": order.rank},
            picture=scatter(
                places, np.array(order.path, np.float64) + 1.0, "across: place in the recording, up: place by name"
            ),
        )
    ]


def repeat_findings(scene: Scene) -> list[Finding]:
    """Frames that occur twice. Raises OSError."""
    frames = scene.frames
    repeated = _repeated_frames(frames)
    if not repeated:
        return []
    shown = [frames[number] for number in repeated[0][::-1]]
    count = "1 frame repeats" if len(repeated) == 1 else f"{len(repeated)} frames repeat"
    pairs = ", ".join(f"{frames[a].name} is {frames[b].name}" for a, b in repeated[:3])
    return [
        Finding(
            cause="repeated frames",
            severity="wrong",
            text=f"{count} the picture of another ({pairs})",
            option="leave them out; --fix OUT does",
            figures={"frames": float(len(repeated))},
            is_mended=True,
            frames=tuple(frames[number].name for number, _ in repeated),
            picture=side_by_side([(frame.name, frame.read_colour(None)) for frame in shown]),
        )
    ]


def _repeated_frames(frames: Sequence[Frame]) -> list[tuple[int, int]]:
    """(the later frame, the first frame) whose picture files are equal byte by byte. Raises OSError."""
    first: dict[bytes, int] = {}
    repeated = []
    for number, frame in enumerate(frames):
        if not frame.file_shows_colour:
            continue
        key = hashlib.blake2b(frame.colour_path.read_bytes(), digest_size=16).digest()
        if first.setdefault(key, number) != number:
            repeated.append((number, first[key]))
    return repeated
