"""Which axis of a world points up: as its format says, or as the cameras show, which people hold upright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene_source import UpAxis

_TO_Z_UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
_CLEARLY_UP = 0.6
_NEARLY_UPRIGHT = 0.99
"""Cosine of 8 degrees: z that is this close to the cameras' up was meant to be up."""
_SPREAD = 0.3
"""Second over first singular value of the cameras' right axes. Below it all cameras look the same way."""


def upright_turn(
    poses: Sequence[NDArray[np.float64]], asked: UpAxis, own: UpAxis | None, *, is_known: bool
) -> tuple[NDArray[np.float64], list[str]]:
    """The rotation, float64 [3, 3], from a capture's world into one with z up, and warnings.

    ``poses`` are its cameras, float64 [4, 4] camera-to-world each. ``own`` is the axis that its format says points up,
    None if it says nothing; ``is_known`` means that it was measured.
    """
    axis: UpAxis | None = "z" if asked == "+z" else own if asked == "z" else asked
    if axis is None:
        return upright_rotation(poses), []
    turn = to_z_up(axis)
    if is_known and axis == own:
        return turn, []
    tilted = up_axis_warning([turned(pose, turn) for pose in poses], axis)
    return turn, [tilted] if tilted else []


def to_z_up(up: UpAxis) -> NDArray[np.float64]:
    """The rotation, float64 [3, 3], of a world whose axis ``up`` points up into one whose z does."""
    return _TO_Z_UP[up]


def turned(pose: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """A camera-to-world pose, float64 [4, 4], in the world that the rotation ``turn``, float64 [3, 3], makes."""
    result = np.eye(4)
    result[:3, :3] = turn @ pose[:3, :3]
    result[:3, 3] = turn @ pose[:3, 3]
    return result


def up_axis_warning(poses: Sequence[NDArray[np.float64]], up: UpAxis) -> str | None:
    """A warning when cameras, float64 [4, 4] camera-to-world each, are upright about another axis than z, else None.

    The mean of the cameras' own up axes is close to the world's. There is no warning when all of them look steeply up
    or down, or lie on their side.
    """
    mean = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    axis = int(np.abs(mean).argmax())
    if abs(mean[axis]) < _CLEARLY_UP or (axis == 2 and mean[2] > 0.0):
        return None
    written = _TO_Z_UP[up].T @ mean
    axis = int(np.abs(written).argmax())
    name = ("-" if written[axis] < 0.0 else "") + "xyz"[axis]
    advice = f"lift with --up {name}" if name in _TO_Z_UP else "turn the poses so that z points up"
    if mean[2] < -_CLEARLY_UP:
        advice = f"{advice}, or check that poses have y down and z forward (OpenGL's and Blender's are the reverse)"
    return f"the cameras' up is the axis {name}, not {up}, so boxes would be tilted: {advice}"


def upright_rotation(poses: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The rotation, float64 [3, 3], into a world in which cameras, float64 [4, 4] camera-to-world each, stand upright.

    The right axis of an upright camera is level in all directions. If all cameras look the same way, that
    leaves their pitch open, and their mean up axis is taken. If z is about up already, the rotation is the identity.
    """
    rights = np.array([pose[:3, 0] for pose in poses])
    mean_up = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    _, strengths, axes = np.linalg.svd(rights, full_matrices=True)
    spread = strengths[1] / strengths[0] if len(strengths) > 1 else 0.0
    up = axes[2] if spread > _SPREAD else mean_up
    length = float(np.linalg.norm(up))
    if length < 1e-9:
        return np.eye(3)
    up = up / length * (-1.0 if up @ mean_up < 0.0 else 1.0)
    if up[2] > _NEARLY_UPRIGHT:
        return np.eye(3)
    return shortest_rotation(up, np.array([0.0, 0.0, 1.0]))


def shortest_rotation(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation, float64 [3, 3], by the least angle from the unit vector ``one`` to ``other``."""
    cosine = float(one @ other)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])  # ``other`` is z in all calls
    x, y, z = np.cross(one, other)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
