"""Make masks as a network would: ``python sample/network_masks.py SCENE [--seed N] [--out FOLDER] [--name NAME]``.

SCENE holds ``gt/semantic``, ``gt/instance``, ``gt/classes.json``, ``depth``, ``pose`` and ``intrinsic``. It writes
``panoptic.json`` (COCO panoptic, its own categories, a score per segment) and ``panoptic/*.png`` (segment id = R + 256
G + 65536 B, 0 = void). All other programs use the ground truth only for evaluation. ``BeliefNoise`` and
``MaskNoise`` of mask_noise.py say what a network gets wrong, and how often.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mask_noise import Ids, MaskNoise, Region, Sight, TrueRegion, detect
from numpy.typing import NDArray
from shared import write_image

Segments = list[dict[str, Any]]
"""COCO's ``segments_info``."""

SMALLEST_STUFF = 40
"""Pixels. A smaller piece of stuff goes with the largest piece of its class."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene folder with gt/")
    parser.add_argument("--seed", type=int, default=0, help="different seeds give different faults (default 0)")
    parser.add_argument("--out", type=Path, help="where panoptic.json and panoptic/ go (default: the scene folder)")
    parser.add_argument("--name", default="panoptic", help="NAME.json and NAME/ are written (default panoptic)")
    options = parser.parse_args()
    write_masks(options.scene, options.out or options.scene, options.seed, name=options.name)


def write_masks(scene: Path, out: Path, seed: int, noise: MaskNoise | None = None, name: str = "panoptic") -> None:
    categories = json.loads((scene / "gt/classes.json").read_text())["categories"]
    (out / name).mkdir(parents=True, exist_ok=True)
    masks, images = {}, []
    for path in sorted((scene / "gt/semantic").glob("*.png")):
        ids, masks[path.stem] = mask_of_frame(scene, path.stem, categories, seed, noise or MaskNoise())
        pixels = np.stack([ids >> 16, ids >> 8 & 255, ids & 255], -1).astype(np.uint8)  # B, G, R
        write_image(out / f"{name}/{path.stem}.png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        height, width = ids.shape
        images.append({"id": path.stem, "file_name": f"{path.stem}.jpg", "width": width, "height": height})
    annotations = [
        {"image_id": frame, "file_name": f"{frame}.png", "segments_info": segments} for frame, segments in masks.items()
    ]
    blocks = []  # one entry a line
    for key, entries in (("images", images), ("annotations", annotations), ("categories", categories)):
        lines = ",\n".join(" " + json.dumps(entry) for entry in entries)
        blocks.append(f'"{key}": [\n{lines}\n]')
    (out / f"{name}.json").write_text("{\n" + ",\n".join(blocks) + "\n}\n")


def mask_of_frame(
    scene: Path, frame: str, categories: list[dict[str, Any]], seed: int, noise: MaskNoise
) -> tuple[Ids, Segments]:
    """The mask of one frame, int32 [H, W], and its segments. Frames do not depend on each other."""
    regions = true_regions(scene, frame, categories)
    is_thing = {entry["name"]: bool(entry["isthing"]) for entry in categories}
    number = {entry["name"]: entry["id"] for entry in categories}
    ids, seen = detect(regions, is_thing, noise, seed, frame)
    return ids, [_segment_info(index + 1, region, number) for index, region in enumerate(seen)]


def true_regions(scene: Path, frame: str, categories: list[dict[str, Any]]) -> list[TrueRegion]:
    """Every thing and every connected piece of stuff in the view, in a fixed order; void belongs to no region."""
    semantic = _read_png(scene / f"gt/semantic/{frame}.png")
    instance = _read_png(scene / f"gt/instance/{frame}.png")
    depth = _read_png(scene / f"depth/{frame}.png") / 1000.0
    pose = np.loadtxt(scene / f"pose/{frame}.txt")
    points = _world_points(depth, np.loadtxt(scene / "intrinsic/intrinsic_color.txt"), pose)
    regions = []
    for entry in categories:
        of_class = semantic == entry["id"]
        if entry["isthing"]:
            pieces = [(f"thing {k}", of_class & (instance == k)) for k in np.unique(instance[of_class])]
        else:
            pieces = [(entry["name"], piece) for piece in _pieces(of_class)]
        for key, pixels in pieces:
            x, y, z = np.round(points[pixels].mean(0), 3).tolist()
            towards = np.array([x, y, z]) - pose[:3, 3]
            u, v, w = np.round(towards / np.linalg.norm(towards), 3).tolist()
            share = float(pixels.mean())
            sight = Sight(key, entry["name"], bool(entry["isthing"]), share, (x, y, z), (u, v, w))
            regions.append(TrueRegion(pixels, sight))
    return regions


def _pieces(pixels: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Connected pieces, the largest first. Fragments go with the largest."""
    _, labels = cv2.connectedComponents(pixels.astype(np.uint8), connectivity=4)
    counts = np.bincount(labels.ravel())
    order = sorted(range(1, len(counts)), key=lambda label: (-counts[label], label))
    pieces = [labels == label for label in order if counts[label] >= SMALLEST_STUFF]
    if pieces:
        for label in order[len(pieces) :]:
            pieces[0] |= labels == label
    return pieces


def _world_points(
    depth: NDArray[np.float64], intrinsic: NDArray[np.float64], pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """World points [H, W, 3] of planar depth in metres; pixel centres at integers, as in the scene's files."""
    y, x = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
    across = (x - intrinsic[0, 2]) / intrinsic[0, 0] * depth
    down = (y - intrinsic[1, 2]) / intrinsic[1, 1] * depth
    # A matrix product may round differently on another machine, sums of terms do not.
    return np.stack([across * row[0] + down * row[1] + depth * row[2] + row[3] for row in pose[:3]], -1)


def _read_png(path: Path) -> NDArray[Any]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise SystemExit(f"cannot read {path}: not a scene with ground truth?")
    return picture


def _segment_info(index: int, region: Region, number: dict[str, int]) -> dict[str, Any]:
    return {
        "id": index,
        "category_id": number[region.class_name],
        "isthing": int(region.is_thing),
        "score": region.score,
        "iscrowd": 0,
        "area": int(region.pixels.sum()),
    }


if __name__ == "__main__":
    main()
