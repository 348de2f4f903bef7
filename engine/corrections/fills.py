"""What replaces removed objects: the cells of the room that are cleared, and new Gaussians and points. A fill is
computed once, from the photos, by `engine/plates`, and kept in a file beside corrections.json. All programs that show
the lift clear and fill with this module alone, so it needs only numpy."""

from __future__ import annotations

from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError, reading
from ..gates import read_plain
from ..job import write_atomically
from ..posed.array_file import MOST_BYTES, read_npz
from ..result_files import SemanticPoints, npz_bytes
from .relabelling import GONE, Labels

FILLS = "fills"
"""The folder of a lift that holds fills, and of a result that holds those that were made anew with it."""
CELL = 0.02
"""Side in metres of a cell that is cleared."""
OPACITY = 0.98
"""Opacity of all Gaussians of a fill."""
CERTAIN, GUESSED = 0.9, 0.5
"""Probability that the class of a point is right where photos saw it, and where nothing did."""
_HARMONIC = 0.28209479177387814  # the spherical harmonic of degree 0: 1 / (2 sqrt(pi))
_MAKE_ANEW = "Put the removed object back and remove it again."
_FARTHEST = 1e4
"""Metres within which a cell's number fits into 21 bits."""


@dataclass(frozen=True, eq=False)
class Fill:
    """What replaces removed objects. ``cells`` int32 [C, 3] are the cells, counted in CELL from the world's origin,
    from which stuff is removed, and things that the fill draws anew. The new Gaussians: ``xyz`` float32 [P, 3] metres,
    ``scale`` float32 [P, 3] standard deviations in metres, ``turn`` float32 [P, 4] unit quaternions wxyz, ``rgb``
    float32 [P, 3] sRGB in [0, 1], ``label`` int32 [P] (see `edits`), ``guessed`` float32 [P], 1 where no photo saw
    their place, and ``is_point`` bool [P], which of them are semantic points, too."""

    cells: NDArray[np.int32]
    xyz: NDArray[np.float32]
    scale: NDArray[np.float32]
    turn: NDArray[np.float32]
    rgb: NDArray[np.float32]
    label: NDArray[np.int32]
    guessed: NDArray[np.float32]
    is_point: NDArray[np.bool_]

    def clears(self, xyz: NDArray[np.floating], label: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return which of ``xyz`` [N, 3] with the labels ``label`` [N] are removed from the cells, bool [N]."""
        return ((label <= 0) | np.isin(label, self.label)) & np.isin(cell_keys(cells_of(xyz)), cell_keys(self.cells))

    def points(self) -> tuple[SemanticPoints, Labels]:
        """Return the semantic points among the Gaussians, and their labels."""
        own = self.is_point
        label = self.label[own]
        rgb = np.rint(255 * self.rgb[own]).astype(np.uint8)
        likely = np.where(self.guessed[own] > 0, np.float32(GUESSED), np.float32(CERTAIN))
        class_id, instance = np.maximum(-label, 0), np.maximum(label, 0)
        return SemanticPoints(self.xyz[own], rgb, class_id, instance, likely.astype(np.float32)), label

    def splats(self, kind: np.dtype[np.void]) -> NDArray[np.void]:
        """Return the Gaussians as rows of gaussians.ply, [P], with the columns of the dtype ``kind``."""
        rows = np.zeros(len(self.xyz), kind)
        columns = {"opacity": np.full(len(rows), np.log(OPACITY / (1 - OPACITY)))}
        for names, values in (
            ("x y z", self.xyz), ("scale_0 scale_1 scale_2", np.log(self.scale)),
            ("rot_0 rot_1 rot_2 rot_3", self.turn), ("red green blue", np.rint(255 * self.rgb)),
            ("f_dc_0 f_dc_1 f_dc_2", (self.rgb - 0.5) / _HARMONIC),
        ):  # fmt: skip
            columns |= dict(zip(names.split(), values.T, strict=True))
        columns |= {"class_id": np.maximum(-self.label, 0), "instance_id": np.maximum(self.label, 0)}
        for name, values in columns.items():
            if name in (kind.names or ()):
                rows[name] = values
        return rows


NOTHING = Fill(
    *(np.zeros((0, width), kind) for width, kind in ((3, np.int32), (3, "f4"), (3, "f4"), (4, "f4"), (3, "f4"))),
    *(np.zeros(0, kind) for kind in (np.int32, "f4", np.bool_)),
)  # fmt: skip
"""A fill that clears and draws nothing."""


def cells_of(xyz: NDArray[np.floating]) -> NDArray[np.int32]:
    """Return the cell of each position [N, 3], int32 [N, 3]."""
    return np.floor(np.clip(xyz, -_FARTHEST, _FARTHEST) / np.float32(CELL)).astype(np.int32)


def with_neighbours(cells: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the cells [N, 3] and the 26 around each, without duplicates, int32 [M, 3]."""
    around = np.stack(np.meshgrid(*[np.arange(-1, 2, dtype=np.int32)] * 3), axis=-1).reshape(-1, 1, 3)
    return np.unique((np.unique(cells, axis=0)[None] + around).reshape(-1, 3), axis=0)


def cell_keys(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return one number for each cell [N, 3], int64 [N], equal for equal cells. It has 21 bits for each axis, and
    repeats beyond these."""
    x, y, z = cells.astype(np.int64).T + (1 << 20) & (1 << 21) - 1
    return x << 42 | y << 21 | z


def path_of(folder: Path, name: str) -> Path:
    """Return the file of a fill in the ``folder`` of a lift or a result."""
    return folder / FILLS / f"{name}.npz"


def write_fill(path: Path, fill: Fill) -> str:
    """Write a fill, and return the file's SHA-256. Raises OSError."""
    content = npz_bytes({one.name: getattr(fill, one.name) for one in fields(fill)})
    write_atomically(path, content)
    return sha256(content).hexdigest()


def read_fill(path: Path, digest: str = "") -> Fill:
    """Read a fill, whose file must have the SHA-256 ``digest``, if given. Raises PlgsError if missing or damaged."""
    if not path.is_file():
        raise PlgsError("fill-missing", "the points that fill a removed object's place are missing", path, _MAKE_ANEW)
    with reading(path, _MAKE_ANEW):
        content = read_plain(path, MOST_BYTES) if digest else b""
    if digest and sha256(content).hexdigest() != digest:
        raise PlgsError("fill-changed", "the points that fill a removed object's place changed", path, _MAKE_ANEW)
    arrays = read_npz(path, _MAKE_ANEW, [one.name for one in fields(Fill)])
    for one in fields(Fill):
        model, array = getattr(NOTHING, one.name), arrays[one.name]
        rows = len(array) if one.name == "cells" else len(arrays["xyz"])
        if array.shape != (rows, *model.shape[1:]) or array.dtype != model.dtype or not np.isfinite(array).all():
            raise PlgsError("fill-damaged", f"the array {one.name} of a filled hole is damaged", path, _MAKE_ANEW)
    if not (arrays["scale"] > 0).all() or (np.abs(arrays["xyz"]) > _FARTHEST).any() or (arrays["label"] == GONE).any():
        raise PlgsError("fill-damaged", "the Gaussians that fill a removed object's place are bad", path, _MAKE_ANEW)
    return Fill(**arrays)
