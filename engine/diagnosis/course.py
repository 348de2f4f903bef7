"""Findings on the course of a recording: order, repeated frames, drift, frames out of place."""

from __future__ import annotations

import numpy as np

from ..scene import Scene
from ..scene.layout import listed
from .examined import Examined, listed_frames
from .finding import Finding
from .order import Order, measure_order, repeated_frames
from .pictures import scatter, side_by_side
from .poses import Drift, measure_drift, misplaced_looks, surface_distances
from .reprojection import Assumption, assumed_poses

_DRIFTED = 0.02
"""Metres, or ..."""
_DRIFTED_SHARE = 0.0075
"""... this part of the middle depth where that is more: sensors' own noise stays below."""
_GROWN = 4.0
_CERTAIN = 5.0


def order_of(scene: Scene, assumed: Assumption) -> Order | None:
    """The order of all frames under an assumption; None where there are too few to tell."""
    poses = np.stack([frame.camera.camera_to_world for frame in scene.frames])
    turn = np.eye(3) if scene.turn is None else scene.turn
    return measure_order(assumed_poses(poses, turn, assumed))


def order_findings(scene: Scene, order: Order | None) -> list[Finding]:
    """Whether the frames are in another order than that of their recording."""
    if order is None or not order.is_shuffled:
        return []
    best = listed([scene.frames[number].name for number in order.path], 6)
    return [
        Finding(
            cause="unsorted frames",
            severity="wrong",
            text=f"frames are not in the order of the recording: what cameras look at moves by {order.given:.2f} m "
            f"from one frame to the next, and by {order.shortest:.2f} m in the order {best}",
            option="name the files in the order of the recording",
            figures={"step_m": order.given, "shortest_step_m": order.shortest, "nearer_share": order.rank},
            frames=(),
            picture=scatter(
                np.arange(len(order.path), dtype=np.float64),
                np.array(order.path, np.float64) + 1.0,
                "across: place in the recording, up: place by name",
            ),
        )  # fmt: skip
    ]


def repeat_findings(scene: Scene) -> list[Finding]:
    """Frames that are there twice. Raises OSError."""
    repeated = repeated_frames(scene.frames)
    if not repeated:
        return []
    names = listed_frames(scene.frames, [later for later, _ in repeated])
    later, first = repeated[0]
    shown = [(scene.frames[number].name, scene.frames[number].read_colour(None)) for number in (first, later)]
    of_one = ", ".join(f"{scene.frames[a].name} is {scene.frames[b].name}" for a, b in repeated[:3])
    return [
        Finding(
            cause="repeated frames",
            severity="wrong",
            text=f"{_counted(len(repeated), 'frame has', 'frames have')} the picture of another one ({of_one})",
            option="leave them out; --fix OUT does",
            figures={"frames": float(len(repeated))},
            is_mended=True,
            frames=names,
            picture=side_by_side(shown),
        )
    ]


def pose_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Drift, or else single frames whose pose is off. The frames have to be in order."""
    distances = surface_distances(examined.views, examined.pairs, assumed)
    numbers = np.array([look.number for look in examined.looks])
    lags = np.abs(numbers[examined.pairs[:, 0]] - numbers[examined.pairs[:, 1]]).astype(np.float64)
    drift = measure_drift(distances, lags, len(examined.looks))
    depth = float(np.median(examined.views.values[examined.views.values > 0.0])) * assumed.unit
    found = [_of_drift(drift)] if drift is not None and _is_drifting(drift, depth) else []
    rows = misplaced_looks(examined.views, examined.pairs, assumed)
    return [*found, *([_of_misplaced(examined, rows)] if rows else [])]


def _is_drifting(drift: Drift, depth: float) -> bool:
    least = max(_DRIFTED, _DRIFTED_SHARE * depth)
    return drift.far > least and drift.far > _GROWN * drift.near and drift.certainty > _CERTAIN


def _of_drift(drift: Drift) -> Finding:
    return Finding(
        cause="drift",
        severity="wrong",
        text=f"poses drift: surfaces that two frames see are {drift.near * 100:.1f} cm apart between neighbours and "
        f"{drift.far * 100:.1f} cm between frames far apart in time ({drift.certainty:.0f} standard errors)",
        option="register the frames again with loops closed, or lift parts of the recording by a splits.json",
        figures={"near_m": drift.near, "far_m": drift.far, "certainty": drift.certainty},
        picture=scatter(drift.lags, drift.distances, "across: frames between two views, up: distance of surfaces"),
    )


def _of_misplaced(examined: Examined, rows: list[int]) -> Finding:
    names = tuple(examined.name(row) for row in rows)
    beside = [max(rows[0] - 1, 0), rows[0]]
    return Finding(
        cause="frames out of place",
        severity="wrong",
        text=f"{_counted(len(rows), 'frame agrees', 'frames agree')} with none beside, which agree with each other: "
        f"{listed(names)}",
        option="leave them out; --fix OUT does",
        figures={"frames": float(len(rows))},
        is_mended=True,
        frames=names,
        picture=side_by_side(
            [(examined.name(row), examined.photos[examined.looks[row].number].grey) for row in beside]
        ),
    )


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"
