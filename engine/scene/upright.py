"""Which way is up in a world whose format does not say: people hold cameras upright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_NEARLY_UPRIGHT = 0.99
"""Cosine of 8 degrees: z that is this close to the cameras' up was meant to be up."""
_SPREAD = 0.3
"""Second against first singular value of the cameras' right axes: below it they all look the same way."""


def upright_rotation(poses: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The rotation, float64 [3, 3], into a world in which cameras, float64 [4, 4] camera-to-world each, stand upright.

    The right axis of an upright camera is level wherever it looks. Where all look the same way that leaves their pitch
    open, and their mean up axis is taken. The identity where z is up already, but for how people hold cameras.
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
    return _shortest_rotation(up, np.array([0.0, 0.0, 1.0]))


def _shortest_rotation(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation, float64 [3, 3], of the least angle that takes the unit vector ``one`` to ``other``."""
    cosine = float(one @ other)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])  # for z alone, which is what it is called with
    x, y, z = np.cross(one, other)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
