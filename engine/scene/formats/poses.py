"""Convert stored poses (quaternions, OpenGL's axes, world-to-camera), and read text files of rows of numbers."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import LARGEST_TABLE
from ...posed.frames import as_pose
from ...posed.layout import read_text
from ...posed.matrices import rigid

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def finite_pose(matrix: NDArray[np.float64], path: Path) -> NDArray[np.float64] | None:
    """Return a camera-to-world pose, float64 [4, 4] or [3, 4], as an exactly rigid [4, 4]; None if a number in it is
    not finite. Raises PlgsError if it is not rigid."""
    if not np.isfinite(matrix).all():
        return None
    pose = np.eye(4)
    pose[: len(matrix)] = matrix
    return rigid(pose, path)


def from_opengl(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a pose, float64 [4, 4], from OpenGL's camera axes (y up, z backward) to OpenCV's (y down, z forward)."""
    return pose @ _FROM_OPENGL


def quaternion_pose(wxyz: Sequence[float], position: Sequence[float], path: Path) -> NDArray[np.float64]:
    """Return the pose, float64 [4, 4], with this rotation and position. Raises PlgsError for a zero quaternion."""
    w, x, y, z = (float(value) for value in wxyz)
    square = w * w + x * x + y * y + z * z
    if not square > 1e-12 or not np.isfinite(square):
        raise PlgsError("zero-quaternion", "a quaternion is zero", path, "Write the rotation as a unit quaternion.")
    s = 2.0 / square  # so that the quaternion may have any length
    rotation = [
        [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
    ]
    return rigid(as_pose(rotation, position), path)


def nearest(times: Sequence[float], time: float, most: float) -> int | None:
    """Return the index of the closest of ascending ``times``, or None if that time is more than ``most`` away."""
    after = bisect_left(times, time)
    near = [i for i in (after - 1, after) if 0 <= i < len(times) and abs(times[i] - time) <= most]
    return min(near, key=lambda i: abs(times[i] - time), default=None)


class Row(NamedTuple):
    """A line's number and its words."""

    line: int
    words: list[str]


def read_rows(path: Path, fix: str, separator: str | None = None, titles: bool = False) -> Iterator[Row]:
    """Yield the non-empty rows of a text file, with a row of column titles only if ``titles`` is set. ``separator``
    None: spaces. Raises PlgsError, with ``fix`` as the advice, for other files."""
    for number, line in enumerate(read_text(path, LARGEST_TABLE, fix).splitlines(), start=1):
        words = [word.strip() for word in line.partition("#")[0].split(separator)]
        # TUM's column titles are comments; some tools remove the #.
        if any(words) and (titles or words[0] != "timestamp"):
            yield Row(number, words)


def numbers(row: Row, path: Path, fix: str, count: int | None = None) -> NDArray[np.float64]:
    """Return a row's words as numbers, float64 [count], perhaps inf or NaN. Raises PlgsError for other words or another
    count, with ``fix`` as the advice."""
    try:
        values = np.array([float(word) for word in row.words])
    except ValueError as error:
        raise PlgsError("not-numbers", f"line {row.line} holds something other than numbers", path, fix) from error
    if count is not None and len(values) != count:
        raise PlgsError("wrong-count", f"line {row.line} holds {len(values)} numbers, not {count}", path, fix)
    return values


def matrix_rows(path: Path, fix: str) -> Iterator[NDArray[np.float64]]:
    """Yield matrices, float64 [4, 4], from lines of 16 or 12 numbers (no last row). Raises PlgsError for other text."""
    for row in read_rows(path, fix):
        values = numbers(row, path, fix)
        if len(values) not in (12, 16):
            raise PlgsError("wrong-count", f"line {row.line} holds {len(values)} numbers, not 16", path, fix)
        yield np.vstack([values.reshape(-1, 4)[:3], [0.0, 0.0, 0.0, 1.0]])
