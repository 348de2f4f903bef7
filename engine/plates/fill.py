"""From completed textures to a fill: the cells that are cleared, and new Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ..corrections.fills import NOTHING, Fill, cell_keys, cells_of, with_neighbours
from .completion import Completed
from .leaving import Leaving
from .planes import Plane
from .texture import Texture

SEAM = 0.04
"""Metres at the rim of what is drawn in which the lift's Gaussians stay, too, as they are larger than texels."""
FLAT = 0.05
"""Metres from a plane within which the lift's Gaussians are replaced by it."""
AROUND = 0.1
"""Metres around the objects' box in which something is left of them over a hole."""
SCALE, THICKNESS = 0.6, 0.002
"""Standard deviations of new Gaussians: in texels along the plane, in metres across it."""
POINTS_APART = 0.03
"""Metres between semantic points of a fill, about."""


def replaced_gaussians(
    centres: NDArray[np.floating], label: NDArray[np.int32], texture: Texture, completed: Completed,
    planes: Sequence[Plane], leaving: Leaving,
) -> NDArray[np.bool_]:  # fmt: skip
    """Which of the lift's Gaussians, with their likeliest ``label`` [G], a texture replaces, bool [G]: those on the
    plane where it is drawn, and stuff over its hole that is on no plane, a remainder of the objects."""
    gone = np.zeros(len(centres), np.bool_)
    local = texture.plane.local(centres)
    cell = np.floor((local[:, :2] - texture.low) / texture.texel).astype(int)
    rows = np.flatnonzero(((cell >= 0) & (cell < texture.seen.shape[::-1])).all(axis=1))
    height, (x, y) = local[rows, 2], cell[rows].T
    near = (centres[rows] > leaving.low - AROUND) & (centres[rows] < leaving.high + AROUND)
    over = near.all(axis=1) & (height >= FLAT) & completed.hole[y, x] & (label[rows] <= 0)
    for plane in planes:
        if plane is not texture.plane:
            over &= np.abs(plane.local(centres[rows])[:, 2]) > 0.04
    inner = distance_transform_edt(np.pad(completed.fill, 1, mode="edge"))[1:-1, 1:-1] * texture.texel > SEAM
    on = (np.abs(height) < FLAT) & ((completed.hole | inner) & completed.fill)[y, x]
    on &= (label[rows] <= 0) | (label[rows] == completed.label[y, x])
    gone[rows] = over | on
    return gone


def gaussians_of(texture: Texture, completed: Completed) -> Fill:
    """New Gaussians, one for each texel that is drawn, in a fill without cells."""
    drawn, t = completed.fill, texture.texel
    xyz = texture.points()[drawn]
    every = max(1, round(POINTS_APART / t))
    y, x = np.nonzero(drawn)
    count = len(xyz)
    return Fill(
        NOTHING.cells,
        xyz.astype(np.float32),
        np.tile(np.array([SCALE * t, SCALE * t, THICKNESS], np.float32), (count, 1)),
        np.tile(quaternion(texture.plane.axes.T), (count, 1)).astype(np.float32),
        completed.colour[drawn],
        completed.label[drawn],
        completed.hole[drawn].astype(np.float32),
        (y % every == 0) & (x % every == 0),
    )


def joined(fills: Sequence[Fill]) -> Fill:
    """All fills in one."""
    return Fill(**{name: np.concatenate([getattr(each, name) for each in [NOTHING, *fills]]) for name in vars(NOTHING)})


def cleared_cells(
    centres: NDArray[np.floating], gone: NDArray[np.bool_], stays: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """The cells, int32 [C, 3], in which and beside which more Gaussians are ``gone`` than stay, bool [G] each."""
    cells = with_neighbours(cells_of(centres[gone]))
    keys = cell_keys(cells)
    gone_in, stay_in = (_counted(keys, cell_keys(cells_of(centres[own]))) for own in (gone, stays))
    return cells[(gone_in > stay_in) | (stay_in == 0)].astype(np.int32)


def _counted(keys: NDArray[np.int64], own: NDArray[np.int64]) -> NDArray[np.int64]:
    """How often each of the ``keys`` is among ``own``."""
    order = np.argsort(keys)
    at = np.minimum(np.searchsorted(keys, own, sorter=order), len(keys) - 1)
    index = order[at][keys[order[at]] == own] if len(keys) else at[:0]
    return np.bincount(index, minlength=len(keys))


def quaternion(m: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation matrix as a quaternion wxyz (Bar-Itzhack 2000)."""
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0], [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m.trace()],
    ]) / 3  # fmt: skip
    values, vectors = np.linalg.eigh(k)
    x, y, z, w = vectors[:, values.argmax()]
    return np.array([w, x, y, z])
