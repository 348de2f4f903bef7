"""Reads the Gaussians of a lift from result/gaussians.ply, whose format other programs use too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..gates import read_plain

_MOST_BYTES = 4 << 30
_LONGEST_HEADER = 8192
_KINDS = {"float": "<f4", "int": "<i4", "uchar": "u1"}
_FARTHEST = 1e6
"""Metres, as for points."""
_NEEDED = {"x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1",
           "rot_2", "rot_3"}  # fmt: skip


def read_gaussians(path: Path) -> NDArray[np.void]:
    """The rows of a splat file, a structured array [N] by its columns' names. Raises PlgsError for other files. Rows
    with numbers that are not finite, or that lie absurdly far away, are left out.
    """
    fix = "Lift the scene again."
    try:
        content = read_plain(path, _MOST_BYTES)
    except OSError as error:
        raise PlgsError(f"the file cannot be read ({error.strerror})", path, fix) from error
    end = content.find(b"end_header\n", 0, _LONGEST_HEADER) + len(b"end_header\n")
    lines = [line.split() for line in content[:end].decode("ascii", "replace").splitlines()]
    properties = [line[1:] for line in lines if line[:1] == ["property"]]
    columns = [(line[1], _KINDS[line[0]]) for line in properties if len(line) == 2 and line[0] in _KINDS]
    names = {name for name, _ in columns}
    is_whole = _NEEDED <= names and len(names) == len(properties)
    if not content.startswith(b"ply\nformat binary_little_endian") or not is_whole:
        raise PlgsError("the file holds no splats", path, fix)
    row = np.dtype(columns)
    if (len(content) - end) % row.itemsize:
        raise PlgsError("the file is damaged", path, fix)
    rows = np.frombuffer(content, row, -1, end)
    is_sound = np.all([np.isfinite(rows[name]) for name in sorted(_NEEDED)], axis=0)
    is_sound &= np.all([np.abs(rows[name]) <= _FARTHEST for name in "xyz"], axis=0)
    return rows if is_sound.all() else rows[is_sound]
