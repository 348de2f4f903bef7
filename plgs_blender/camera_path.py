"""One camera that moves along the frames: what the single cameras show, as an animation that other programs take."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..engine.scene import Frame
from .cameras import lens_of, object_matrix
from .compat import add_keys
from .frames import DISPLAY_SIZE, set_lens
from .owned import OwnedDataBlocks

PATH = "camera_path"
"""What the camera is in its lift."""


def place_camera_path(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, frames: Sequence[Frame], start: int
) -> bpy.types.Object:
    """A camera with keys at the frames' places on the timeline, of which `start` is the first one's.

    Between two frames the pose moves linearly, for motion blur; the lens jumps, as it is another picture's. Keys that
    the user set on it go.
    """
    data = owned.data_of(PATH) or owned.new_data(bpy.data.cameras.new("Camera path"), PATH)
    set_lens(data, frames[0].camera)
    data.display_size = DISPLAY_SIZE
    ob = owned.object(PATH, "Camera path", data, parent)
    ob.rotation_mode, ob.scale = "QUATERNION", (1.0, 1.0, 1.0)
    times = np.arange(start, start + len(frames), dtype=np.float64)
    matrices = [Matrix(object_matrix(frame.camera).tolist()) for frame in frames]
    lenses = [lens_of(frame.camera) for frame in frames]
    moving, zooming = (_new_action(owned, part) for part in ("pose", "lens"))
    add_keys(ob, moving, "location", times, np.array([matrix.translation for matrix in matrices]), "LINEAR")
    turns = _continuous(np.array([matrix.to_quaternion() for matrix in matrices]))
    add_keys(ob, moving, "rotation_quaternion", times, turns, "LINEAR")
    for path, values in (
        ("lens", [lens.focal_length for lens in lenses]),
        ("shift_x", [lens.shift_x for lens in lenses]),
        ("shift_y", [lens.shift_y for lens in lenses]),
    ):
        add_keys(data, zooming, path, times, np.array(values), "CONSTANT")
    return ob


def _new_action(owned: OwnedDataBlocks, part: str) -> bpy.types.Action:
    """An empty action in place of an earlier placement's."""
    key = f"{PATH}:{part}"
    owned.drop("actions", key)
    action: bpy.types.Action = owned.block("actions", key, lambda: bpy.data.actions.new(f"Camera path {part}"))
    return action


def _continuous(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same rotations as quaternions [N, 4] none of which is more than half a turn from the one before."""
    signs = np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    return turns * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
