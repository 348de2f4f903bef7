"""Make a scene of 7-Scenes' red kitchen: ``python sample/red_kitchen.py DATA OUT [--every 10]``.

DATA is the folder ``data`` of a checkout of the public repository tsdf-fusion-python: 1000 frames of a real hand-held
RGB-D camera (auto exposure, motion blur, holes in the depth). OUT is lifted with ``--up -y``. It has no labels: one
segment of stuff covers each picture, so the figures are those of colour and depth alone.

Poses and intrinsics are the depth camera's. The colour camera has another lens and stands beside it; its photos stay
as they are, depth and poses are brought to it (``ColourCamera``).

7-Scenes is Microsoft's (Shotton et al. 2013), under a licence for research only: never commit its pictures, nor
anything made of them.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from public_data import BadInput, new_scene, run, write_image

EVERY = 10
NO_DEPTH = 65535
SURFACE = {"id": 1, "name": "surface", "isthing": 0}
FOLDERS = ("color", "depth", "pose", "intrinsic", "panoptic")
FIX = "Give the folder data of tsdf-fusion-python."


class ColourCamera(NamedTuple):
    """Of 640x480 photos: focal length and middle in pixels (whole numbers are pixels' centres), and how far it stands
    to the right of the depth camera, in metres.

    Measured, as there is no calibration: with these, of a grid of values, surfaces have most nearly one colour in views
    a second apart (24.2 dB after a fit of the colours; 19.2 dB if photos are taken to be the depth camera's).
    """

    size: tuple[int, int] = (640, 480)
    focal: float = 520.0
    middle: tuple[float, float] = (320.0, 238.0)
    beside: float = 0.025

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Float64 [4, 4], as the scene's layout has it."""
        matrix = np.eye(4)
        matrix[0, 0] = matrix[1, 1] = self.focal
        matrix[:2, 2] = self.middle
        return matrix

    def pose(self, depth_pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Camera-to-world float64 [4, 4], of the depth camera's."""
        step = np.eye(4)
        step[0, 3] = self.beside
        return depth_pose @ step

    def depth(self, depth: NDArray[np.uint16], intrinsics: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Depth as this camera sees it, uint16 [H, W] millimetres (0 = none).

        Each pixel goes where its point is seen; of several the nearest stays. ``intrinsics`` [3, 3] are the depth's.
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
    """Write the scene and return how many frames it has.

    Raises BadInput, and OSError when OUT cannot be written. Nothing is left of a scene that could not be made whole.
    """
    names = [path.name.removesuffix(".color.jpg") for path in sorted(data.glob("frame-*.color.jpg"))][::every]
    if not names:
        raise BadInput("there are no frames (frame-*.color.jpg)", data, FIX)
    with new_scene(out, FOLDERS):
        depth_lens = read_matrix(data / "camera-intrinsics.txt", 3)
        np.savetxt(out / "intrinsic/intrinsic_color.txt", COLOUR.intrinsics)
        annotations = [add_frame(data, out, name, depth_lens) for name in names]
        (out / "panoptic.json").write_text(json.dumps({"annotations": annotations, "categories": [SURFACE]}))
    return len(names)


def add_frame(data: Path, out: Path, frame: str, depth_lens: NDArray[np.float64]) -> dict[str, object]:
    """Write one frame, and return its entry in the table of masks."""
    name = frame.removeprefix("frame-")
    depth = COLOUR.depth(read_depth(data / f"{frame}.depth.png"), depth_lens)
    pose = COLOUR.pose(read_matrix(data / f"{frame}.pose.txt", 4))
    shutil.copyfile(data / f"{frame}.color.jpg", out / f"color/{name}.jpg")
    write_image(out / f"depth/{name}.png", depth)
    np.savetxt(out / f"pose/{name}.txt", pose)
    blue_green_red = np.zeros((*depth.shape, 3), np.uint8)
    blue_green_red[..., 2] = SURFACE["id"]
    write_image(out / f"panoptic/{name}.png", blue_green_red)
    segment = {"id": SURFACE["id"], "category_id": SURFACE["id"], "area": depth.size}
    return {"image_id": name, "file_name": f"{name}.png", "segments_info": [segment]}


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Millimetres, uint16 [H, W], 0 = none. Raises BadInput."""
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if depth is None:
        raise BadInput("there is no depth that can be read", path, FIX)
    width, height = COLOUR.size
    if depth.dtype != np.uint16 or depth.shape != (height, width):
        raise BadInput(f"is no depth of {width}x{height} pixels with 16 bits each", path, FIX)
    return np.where(depth == NO_DEPTH, 0, depth).astype(np.uint16)


def read_matrix(path: Path, side: int) -> NDArray[np.float64]:
    """Float64 [side, side]. Raises BadInput."""
    try:
        matrix = np.loadtxt(path)
    except (OSError, ValueError) as error:
        raise BadInput("there are no numbers that can be read", path, FIX) from error
    if matrix.shape != (side, side) or not np.isfinite(matrix).all():
        raise BadInput(f"is no matrix of {side} x {side} numbers", path, FIX)
    return matrix


if __name__ == "__main__":
    sys.exit(run(make_scene, __doc__ or "", "the folder data of tsdf-fusion-python", EVERY, "lift it with --up -y"))
