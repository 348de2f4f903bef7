"""Make a scene from 7-Scenes' red kitchen: ``python sample/red_kitchen.py DATA OUT [--every 10]``.

DATA is the folder ``data`` of a checkout of the public repository tsdf-fusion-python: 1000 frames of a real hand-held
RGB-D camera (auto exposure, motion blur, holes in the depth). Lift OUT with ``--up -y``. There are no labels. One
segment of stuff covers each picture, so a lift has figures only for colour and depth.

Poses and intrinsics are those of the depth camera. The colour camera has another lens and stands beside it. Its photos
stay as they are, while depth and poses are converted to it (``ColourCamera``).

7-Scenes belongs to Microsoft (Shotton et al. 2013). Its licence is for research only: never commit its pictures, nor
anything made of them.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scene_files import (
    PlgsError,
    Segments,
    mask_pixels,
    new_scene,
    read_image,
    run_on_data,
    write_image,
    write_intrinsics,
    write_mask_table,
)

EVERY = 10
NO_DEPTH = 65535
"""Value of a pixel without depth in DATA."""
SURFACE = {"id": 1, "name": "surface", "isthing": 0}
FIX = "Give the folder data of tsdf-fusion-python."


class ColourCamera(NamedTuple):
    """The camera of the 640x480 photos. Focal length and principal point are in pixels (centres at whole numbers). It
    stands ``beside`` metres to the right of the depth camera.

    There is no calibration, so these were measured: of a grid of values, they give surfaces most nearly one colour in
    views a second apart (24.2 dB after a fit of the colours, 19.2 dB with the depth camera's lens and place).
    """

    size: tuple[int, int] = (640, 480)
    focal: float = 520.0
    middle: tuple[float, float] = (320.0, 238.0)
    beside: float = 0.025

    def pose(self, depth_pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Camera-to-world float64 [4, 4], from that of the depth camera."""
        step = np.eye(4)
        step[0, 3] = self.beside
        return depth_pose @ step

    def depth(self, depth: NDArray[np.uint16], intrinsics: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Depth as this camera sees it, uint16 [H, W] millimetres (0 = none).

        Each pixel goes to where its point is seen, and the nearest wins. ``intrinsics`` [3, 3] belong to ``depth``.
        """
        rows, columns = np.nonzero(depth)
        z = depth[rows, columns]
        x = (columns - intrinsics[0, 2]) / intrinsics[0, 0] - self.beside / (z / 1000.0)
        y = (rows - intrinsics[1, 2]) / intrinsics[1, 1]
        u = np.rint(self.focal * x + self.middle[0]).astype(np.int64)
        v = np.rint(self.focal * y + self.middle[1]).astype(np.int64)
        inside = (u >= 0) & (u < self.size[0]) & (v >= 0) & (v < self.size[1])
        seen = np.full(depth.shape, NO_DEPTH, np.uint16)
        np.minimum.at(seen, (v[inside], u[inside]), z[inside])
        return np.where(seen == NO_DEPTH, 0, seen).astype(np.uint16)


COLOUR = ColourCamera()


def make_scene(data: Path, out: Path, every: int) -> int:
    """Write the scene as a whole or not at all, and return the number of its frames. Raises PlgsError, OSError."""
    names = [path.name.removesuffix(".color.jpg") for path in sorted(data.glob("frame-*.color.jpg"))][::every]
    if not names:
        raise PlgsError("there are no frames (frame-*.color.jpg)", data, FIX)
    with new_scene(out, ("color", "depth", "pose", "intrinsic", "panoptic")):
        depth_lens = read_matrix(data / "camera-intrinsics.txt", 3)
        write_intrinsics(out, COLOUR.focal, COLOUR.middle)
        masks = {name.removeprefix("frame-"): add_frame(data, out, name, depth_lens) for name in names}
        write_mask_table(out / "panoptic.json", masks, [SURFACE])
    return len(names)


def add_frame(data: Path, out: Path, frame: str, depth_lens: NDArray[np.float64]) -> Segments:
    """Write one frame, and return the segments of its mask."""
    name = frame.removeprefix("frame-")
    measured = read_image(data / f"{frame}.depth.png", np.uint16, COLOUR.size, FIX)
    depth = COLOUR.depth(np.where(measured == NO_DEPTH, 0, measured).astype(np.uint16), depth_lens)
    pose = COLOUR.pose(read_matrix(data / f"{frame}.pose.txt", 4))
    shutil.copyfile(data / f"{frame}.color.jpg", out / f"color/{name}.jpg")
    write_image(out / f"depth/{name}.png", depth)
    np.savetxt(out / f"pose/{name}.txt", pose)
    write_image(out / f"panoptic/{name}.png", mask_pixels(np.full(depth.shape, SURFACE["id"])))
    return [{"id": SURFACE["id"], "category_id": SURFACE["id"], "area": depth.size}]


def read_matrix(path: Path, side: int) -> NDArray[np.float64]:
    """Float64 [side, side]. Raises PlgsError."""
    try:
        matrix = np.loadtxt(path)
    except (OSError, ValueError) as error:
        raise PlgsError("there are no numbers that can be read", path, FIX) from error
    if matrix.shape != (side, side) or not np.isfinite(matrix).all():
        raise PlgsError(f"this is not a matrix of {side} x {side} numbers", path, FIX)
    return matrix


if __name__ == "__main__":
    sys.exit(
        run_on_data(make_scene, __doc__ or "", "the folder data of tsdf-fusion-python", EVERY, "lift it with --up -y")
    )
