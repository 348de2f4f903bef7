"""Make a fill from completed textures: the cells that are cleared, and new Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from ..corrections.fills import NOTHING, Fill, cell_keys, cells_of, with_neighbours
from .completion import Completed
from .leaving import Others
from .texture import Texture

SEAM = 0.04
"""Metres at the rim of what is drawn in which the lift's Gaussians stay, too, as they are larger than texels."""
FLAT, BEHIND = 0.05, 0.3
"""Metres from a plane within which the lift's Gaussians are replaced by it, and metres behind it within which those are
that no surface of anything else supports: they are wide, and would shine through."""
SCALE, THICKNESS = 0.8, 0.002
"""Standard deviations of new Gaussians: in texels along the plane, where 0.8 lets 1 % through (0.6: 7 %), in metres
across it."""
POINTS_APART = 0.03
"""Metres between semantic points of a fill, about."""


def replaced_gaussians(
    centres: NDArray[np.floating], label: NDArray[np.int32], texture: Texture, completed: Completed, others: Others
) -> NDArray[np.bool_]:
    """Return which of the lift's Gaussians, at ``centres`` [G, 3], the ``completed`` texture replaces, bool [G]: those
    on the plane where it is drawn, and those behind it that are on no ``others``. ``label`` [G]: the likeliest."""
    gone = np.zeros(len(centres), np.bool_)
    local = texture.plane.local(centres)
    cell = np.floor((local[:, :2] - texture.low) / texture.texel).astype(int)
    inside = ((cell >= 0) & (cell < texture.seen.shape[::-1])).all(axis=1)
    rows = np.flatnonzero(inside & (local[:, 2] < FLAT) & (local[:, 2] > -BEHIND))
    rows = rows[(local[rows, 2] > -FLAT) | others.are_far_from(centres[rows])]
    x, y = cell[rows].T
    inner = distance_transform_edt(np.pad(completed.fill, 1, mode="edge"))[1:-1, 1:-1] * texture.texel > SEAM
    drawn = ((completed.hole | inner) & completed.fill)[y, x]
    gone[rows] = drawn & ((label[rows] <= 0) | (label[rows] == completed.label[y, x]))
    return gone


def gaussians_of(texture: Texture, completed: Completed) -> Fill:
    """Return the fill of a texture: a new Gaussian for each texel that is drawn. The fill clears no cells."""
    drawn, t = completed.fill, texture.texel
    xyz = texture.points()[drawn]
    every = max(1, round(POINTS_APART / t))
    y, x = np.nonzero(drawn)
    count, turn = len(xyz), Rotation.from_matrix(texture.plane.axes.T).as_quat(scalar_first=True)
    return Fill(
        NOTHING.cells,
        xyz.astype(np.float32),
        np.tile(np.array([SCALE * t, SCALE * t, THICKNESS], np.float32), (count, 1)),
        np.tile(turn, (count, 1)).astype(np.float32),
        completed.colour[drawn],
        completed.label[drawn],
        completed.hole[drawn].astype(np.float32),
        (y % every == 0) & (x % every == 0),
    )


def joined(fills: Sequence[Fill]) -> Fill:
    """Join several fills into one."""
    return Fill(**{name: np.concatenate([getattr(each, name) for each in [NOTHING, *fills]]) for name in vars(NOTHING)})


def cleared_cells(
    centres: NDArray[np.floating], gone: NDArray[np.bool_], stays: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """Return the cells to clear of Gaussians, int32 [C, 3]. Cells at or beside ``gone`` Gaussians, bool [G], are
    cleared if in them more are gone than stay (``stays``, bool [G]), or if none stays."""
    cells = with_neighbours(cells_of(centres[gone]))
    keys, owned = cell_keys(cells), [np.sort(cell_keys(cells_of(centres[own]))) for own in (gone, stays)]
    gone_in, stay_in = (np.searchsorted(own, keys, "right") - np.searchsorted(own, keys) for own in owned)
    return cells[(gone_in > stay_in) | (stay_in == 0)].astype(np.int32)
