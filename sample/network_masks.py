"""Make masks as a network would: ``python sample/network_masks.py SCENE [--weak] [--seed N] [--out FOLDER]``.

SCENE is a scene with ground truth and depth, in any layout. It writes ``panoptic.json`` (COCO panoptic, a score per
segment) and ``panoptic/*.png`` (segment id = R + 256 G + 65536 B, 0 = void). All other programs use the ground truth
only for evaluation. ``BeliefNoise`` and ``MaskNoise`` of mask_noise.py say what a network gets wrong, and how often."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mask_noise import BeliefNoise, Ids, MaskNoise, Region, Sight, TrueRegion, detect
from numpy.typing import NDArray
from shared import write_image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from engine.scene import Camera, ClassTable, Frame, open_scene

Segments = list[dict[str, Any]]
"""COCO's ``segments_info``."""

SMALLEST_STUFF = 40
"""Pixels. A smaller piece of stuff goes with the largest piece of its class."""
WEAK = MaskNoise(BeliefNoise(thing_margin=1.5, stuff_margin=1.3))
"""A network that is about as unsure as small ones are (docs/experiments.md)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene with ground truth")
    parser.add_argument("--weak", action="store_true", help="as a network that is often wrong")
    parser.add_argument("--seed", type=int, default=0, help="different seeds give different faults (default 0)")
    parser.add_argument("--out", type=Path, help="where panoptic.json and panoptic/ go (default: the scene folder)")
    parser.add_argument("--name", default="panoptic", help="NAME.json and NAME/ are written (default panoptic)")
    options = parser.parse_args()
    noise = WEAK if options.weak else MaskNoise()
    write_masks(options.scene, options.out or options.scene, options.seed, noise, options.name)


def write_masks(scene: Path, out: Path, seed: int, noise: MaskNoise, name: str = "panoptic") -> None:
    """Write masks of all frames of a scene, and their JSON, into ``out``. Raises PlgsError for unreadable scenes."""
    read = open_scene(scene)
    (out / name).mkdir(parents=True, exist_ok=True)
    images, annotations = [], []
    for frame in read.frames:
        ids, segments = mask_of_frame(frame, read.classes, seed, noise)
        pixels = np.stack([ids >> 16, ids >> 8 & 255, ids & 255], -1).astype(np.uint8)  # B, G, R
        write_image(out / f"{name}/{frame.name}.png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        height, width = ids.shape
        images.append({"id": frame.name, "file_name": frame.colour_path.name, "width": width, "height": height})
        annotations.append({"image_id": frame.name, "file_name": f"{frame.name}.png", "segments_info": segments})
    categories = [{"id": one.id, "name": one.name, "isthing": int(one.is_thing)} for one in read.classes.categories]
    blocks = []  # one entry a line
    for key, entries in (("images", images), ("annotations", annotations), ("categories", categories)):
        lines = ",\n".join(" " + json.dumps(entry) for entry in entries)
        blocks.append(f'"{key}": [\n{lines}\n]')
    (out / f"{name}.json").write_text("{\n" + ",\n".join(blocks) + "\n}\n")


def mask_of_frame(frame: Frame, classes: ClassTable, seed: int, noise: MaskNoise) -> tuple[Ids, Segments]:
    """Return a frame's mask, int32 [H, W], and segments, whatever other frames show. Raises PlgsError for bad files."""
    regions = true_regions(frame, classes)
    is_thing = {entry.name: entry.is_thing for entry in classes.categories}
    number = {entry.name: entry.id for entry in classes.categories}
    ids, seen = detect(regions, is_thing, noise, seed, frame.name)
    return ids, [_segment_info(index + 1, region, number) for index, region in enumerate(seen)]


def true_regions(frame: Frame, classes: ClassTable) -> list[TrueRegion]:
    """Return every thing and every connected piece of stuff in the view, in a fixed order; void belongs to no region.
    Raises PlgsError, and SystemExit without ground truth."""
    if frame.read_ground_truth is None:
        raise SystemExit(f"no ground truth for {frame.colour_path}: made masks need it")
    truth = frame.read_ground_truth(None)
    height, width = truth.semantic.shape
    points = _world_points(np.round(frame.depth((width, height)).astype(np.float64), 3), frame.camera)
    regions = []
    for entry in classes.categories:
        of_class = truth.semantic == entry.id
        if entry.is_thing:
            pieces = [(f"thing {k}", of_class & (truth.instance == k)) for k in np.unique(truth.instance[of_class])]
        else:
            pieces = [(entry.name, piece) for piece in _pieces(of_class)]
        for key, pixels in pieces:
            x, y, z = np.round(points[pixels].mean(0), 3).tolist()
            towards = np.array([x, y, z]) - frame.camera.centre
            u, v, w = np.round(towards / np.linalg.norm(towards), 3).tolist()
            sight = Sight(key, entry.name, entry.is_thing, float(pixels.mean()), (x, y, z), (u, v, w))
            regions.append(TrueRegion(pixels, sight))
    return regions


def _pieces(pixels: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return connected pieces, bool [H, W] each, the largest first. Fragments are added to the largest."""
    _, labels = cv2.connectedComponents(pixels.astype(np.uint8), connectivity=4)
    counts = np.bincount(labels.ravel())
    order = sorted(range(1, len(counts)), key=lambda label: (-counts[label], label))
    pieces = [labels == label for label in order if counts[label] >= SMALLEST_STUFF]
    if pieces:
        for label in order[len(pieces) :]:
            pieces[0] |= labels == label
    return pieces


def _world_points(depth: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return world points [H, W, 3] of planar depth [H, W] in metres."""
    y, x = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]] + 0.5
    across = (x - camera.cx) / camera.fx * depth
    down = (y - camera.cy) / camera.fy * depth
    # A matrix product may round differently on another machine, sums of terms do not.
    pose = camera.camera_to_world[:3]
    return np.stack([across * row[0] + down * row[1] + depth * row[2] + row[3] for row in pose], -1)


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
