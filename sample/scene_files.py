"""What the sample's programs share: the files of a scene's folder, and how the programs refuse."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from engine.errors import PlgsError

FOLDERS = ("color", "depth", "pose", "intrinsic", "panoptic", "gt/semantic", "gt/instance")

Segments = list[dict[str, Any]]
"""COCO's ``segments_info``."""


def run(make: Callable[[], str]) -> int:
    """Make something, print the line that ``make`` returns, and return the exit code. A refusal is one line too."""
    try:
        print(make())
    except (PlgsError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


@contextmanager
def new_scene(out: Path, folders: Iterable[str] = FOLDERS) -> Iterator[None]:
    """Make the folders of a scene. If what is done within fails, the scene is deleted.

    Raises PlgsError when OUT already holds something, OSError when the folders cannot be made.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PlgsError("this exists already", out, "Give a new or empty folder.")
    try:
        for folder in folders:
            (out / folder).mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)  # it was new or empty
        raise


def read_image(path: Path, kind: type[np.generic], size: tuple[int, int], fix: str, channels: int = 1) -> NDArray[Any]:
    """Pixels of this kind and size (width, height), [H, W] or B, G, R [H, W, 3]. Raises PlgsError."""
    how = cv2.IMREAD_COLOR if channels == 3 else cv2.IMREAD_UNCHANGED
    pixels = cv2.imread(str(path), how) if path.is_file() else None
    if pixels is None:
        raise PlgsError("there is no readable picture", path, fix)
    if pixels.dtype != kind or pixels.shape != (size[1], size[0], *((3,) if channels == 3 else ())):
        bits = 8 * np.dtype(kind).itemsize
        raise PlgsError(f"not a picture of {size[0]}x{size[1]} pixels, {channels} x {bits} bits each", path, fix)
    return pixels


def write_image(path: Path, pixels: NDArray[np.generic], how: Sequence[int] = ()) -> None:
    """Write pixels, [H, W] or B, G, R [H, W, 3]. ``how`` holds OpenCV's parameters and values. Raises OSError."""
    if not cv2.imwrite(str(path), np.ascontiguousarray(pixels), how):
        raise OSError(f"cannot be written: {path}. Choose a folder that you may write to, on a disk with space.")


def write_intrinsics(out: Path, focal: float, middle: tuple[float, float]) -> None:
    """The layout's 4x4 matrix. ``middle`` (x, y) is the principal point, for pixel centres at whole numbers."""
    matrix = np.diag([focal, focal, 1.0, 1.0])
    matrix[:2, 2] = middle
    np.savetxt(out / "intrinsic/intrinsic_color.txt", matrix, fmt="%.9f")


def pose_towards(eye: NDArray[np.float64], forward: NDArray[np.float64], up: ArrayLike) -> NDArray[np.float64]:
    """The camera-to-world pose, float64 [4, 4], at ``eye`` with a view along the unit vector ``forward``."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    return pose


def write_split(out: Path, names: Sequence[str], held_out: Iterable[int]) -> None:
    """``held_out`` are places in ``names``."""
    test = [names[place] for place in held_out]
    split = {"train": [name for name in names if name not in {*test}], "test": test}
    (out / "splits.json").write_text(json.dumps(split, indent=1) + "\n")


def mask_pixels(ids: NDArray[np.integer]) -> NDArray[np.uint8]:
    """The picture of segment ids [H, W] as R + 256 G + 65536 B, in OpenCV's order B, G, R."""
    return np.stack([ids >> 16, ids >> 8 & 255, ids & 255], -1).astype(np.uint8)


def write_mask_table(
    path: Path, masks: Mapping[str, Segments], categories: Segments, images: Segments | None = None
) -> None:
    """COCO panoptic's table, one entry per line. ``masks`` is keyed by the frames' names."""
    annotations = [
        {"image_id": name, "file_name": f"{name}.png", "segments_info": segments} for name, segments in masks.items()
    ]
    table = {**({"images": images} if images else {}), "annotations": annotations, "categories": categories}
    blocks = []
    for key, entries in table.items():
        lines = ",\n".join(" " + json.dumps(entry) for entry in entries)
        blocks.append(f'"{key}": [\n{lines}\n]')
    path.write_text("{\n" + ",\n".join(blocks) + "\n}\n")
