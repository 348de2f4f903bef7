"""Spoils a scene folder in the present layout, one defect at a time, as users' own conversions do."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def poses(folder: Path, change: Callable[[int, Floats], Floats]) -> None:
    """Rewrite every pose, float64 [4, 4], given its number in the recording."""
    for number, path in enumerate(sorted((folder / "pose").iterdir())):
        np.savetxt(path, change(number, np.loadtxt(path)), "%.12g")


def farther(pose: Floats, times: float) -> Floats:
    """The pose, float64 [4, 4], with its place so many times as far from the origin."""
    return pose * np.array([[1.0, 1.0, 1.0, times]] * 3 + [[1.0] * 4])


def intrinsics(folder: Path, change: Callable[[Floats], Floats]) -> None:
    """Rewrite K; the change sees pixel centres at +0.5."""
    path = folder / "intrinsic" / "intrinsic_color.txt"
    half = np.zeros((4, 4))
    half[:2, 2] = 0.5
    np.savetxt(path, change(np.loadtxt(path) + half) - half, "%.12g")


def depths(folder: Path, change: Callable[[Floats], Floats]) -> None:
    """Rewrite every depth image, float64 [H, W] in steps."""
    for path in sorted((folder / "depth").iterdir()):
        steps = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float64))
        cv2.imwrite(str(path), np.clip(np.round(steps), 0, 65535).astype(np.uint16))


def colours(folder: Path, change: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]]) -> None:
    """Rewrite every colour image, uint8 [H, W, 3], given its number in the recording."""
    for number, path in enumerate(sorted((folder / "color").iterdir())):
        cv2.imwrite(str(path), change(number, cv2.imread(str(path))))


def ray_lengths(folder: Path, shape: tuple[int, ...]) -> Floats:
    """The length of each pixel's ray with z = 1, float64 [H, W]; depth has the colour's size."""
    matrix = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")
    x = (np.arange(shape[1]) - matrix[0, 2]) / matrix[0, 0]
    y = (np.arange(shape[0]) - matrix[1, 2]) / matrix[1, 1]
    return np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2)


def rename(folder: Path, order: list[int]) -> None:
    """Give the frames other names: the i-th name goes to the frame ``order[i]``."""
    names = sorted(path.stem for path in (folder / "pose").iterdir())
    for kind in ("color", "depth", "pose", "panoptic", "gt/semantic", "gt/instance"):
        files = {path.stem: path for path in (folder / kind).iterdir()}
        parked = [files[name].rename(files[name].with_suffix(".parked")) for name in names]
        suffix = next(iter(files.values())).suffix
        for name, number in zip(names, order, strict=True):
            parked[number].rename(folder / kind / f"{name}{suffix}")
    table = folder / "panoptic.json"
    content = json.loads(table.read_text())
    new_name = {names[number]: name for name, number in zip(names, order, strict=True)}
    for entry in content["annotations"]:
        entry["image_id"] = new_name[entry["image_id"]]
        entry["file_name"] = f"{entry['image_id']}.png"
    table.write_text(json.dumps(content))


def repeat(folder: Path, name: str, instead_of: str, kinds: tuple[str, ...] = ("color", "depth", "pose")) -> None:
    """Replace one frame by a copy of another one."""
    for kind in kinds:
        (source,) = (folder / kind).glob(f"{name}.*")
        shutil.copyfile(source, folder / kind / f"{instead_of}{source.suffix}")
