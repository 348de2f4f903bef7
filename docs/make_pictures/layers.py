"""An input mask beside what was lifted, the layers of a baked frame, and the strip on README's first screen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from plgs.engine.passes.exr import read_exr
from plgs.engine.passes.previews import colour_picture, instance_picture, semantic_picture, shaded
from plgs.engine.scene import distinct_colour, open_scene
from plgs.plgs_blender.pass_nodes import INSTANCES
from plgs.plgs_blender.results import LiftResult

from .blender import CAMERA, SHOT_FRAME
from .sheets import Picture, before_ground, bytes_of, grey, tiled

MASK_FRAME = "0016"
"""A held-out frame. Its mask has faults that lifting mends: holes, a vase that is a bin, pieces of windows."""
Planes = Mapping[str, NDArray[np.float32]]
WINDOW = Path(__file__).resolve().parent.parent / "pictures" / "window_overview.jpg"
WINDOW_PART = np.s_[90:870, 0:1040]
"""The 3D view and the panel in that picture, 4:3."""


def mask_picture(result: LiftResult) -> Picture:
    """A held-out frame: photo, input mask, and the lift, which saw neither."""
    tiles = frame_tiles(result)
    names = (f"photo, frame {MASK_FRAME}", "its input mask (black: none)", "lifted classes", "lifted instances")
    return tiled(dict(zip(names, tiles, strict=True)), 2, 560)


def strip_picture(result: LiftResult) -> Picture:
    """One row: photo, input mask, lifted instances, the window, and a matte."""
    photo, mask, _, instances = frame_tiles(result)
    window = cv2.cvtColor(cv2.imread(str(WINDOW)), cv2.COLOR_BGR2RGB)[WINDOW_PART]
    tiles = {
        "photo (held out)": photo,
        "input mask": mask,
        "lifted instances": instances,
        "in Blender": np.asarray(window, np.uint8),
        **cut_out(result),
    }
    return tiled(tiles, len(tiles), 400)


def frame_tiles(result: LiftResult) -> tuple[Picture, Picture, Picture, Picture]:
    """Photo, input mask, lifted classes and lifted instances of the held-out frame."""
    frame = next(each for each in open_scene(result.scene.folder).frames if each.name == MASK_FRAME)
    photo, mask = frame.read_colour(frame.size), frame.mask(frame.size)
    layers = read_exr(result.passes[MASK_FRAME])
    return (
        photo,
        shaded(semantic_picture(mask.class_map(), result.classes), photo),
        shaded(semantic_picture(layers.semantic, result.classes), photo),
        shaded(instance_picture(layers.instance, instance_colours(result)), photo),
    )


def cut_out(result: LiftResult) -> dict[str, Picture]:
    """The largest instance of the held-out frame, cut out of the rendered picture by its Cryptomatte coverage."""
    path = result.passes[MASK_FRAME]
    layers, planes = read_exr(path), planes_of(path)
    largest = max(result.instances, key=lambda one: int((layers.instance == one.id).sum()))
    crypto_ids = planes[f"{INSTANCES}00.r"][layers.instance == largest.id]
    ids, counts = np.unique(crypto_ids, return_counts=True)
    coverage = sum(np.where(key == ids[counts.argmax()], share, 0.0) for key, share in ranks_of(planes, INSTANCES))
    picture = np.concatenate([colour_picture(layers), bytes_of(np.asarray(coverage))[..., None]], axis=-1)
    return {f"matte of {largest.name}": before_ground(picture, square=10)}


def layers_picture(result: LiftResult) -> Picture:
    """All layers of one frame of the moving camera."""
    path = result.shots[f"{CAMERA}.{SHOT_FRAME:04d}"]
    layers, planes = read_exr(path), planes_of(path)
    normal, position = (
        np.stack([planes[f"PLGS.{name}.{axis}"] for axis in "XYZ"], axis=-1) for name in ("Normal", "Position")
    )
    return tiled(
        {
            "Combined": colour_picture(layers),
            "Semantic (class ids)": semantic_picture(layers.semantic, result.classes),
            "Instance (ids; grey: none)": instance_picture(layers.instance, instance_colours(result)),
            "Depth, near is bright": grey(1.0 - layers.depth / np.percentile(layers.depth, 99.5)),
            "Normal, world": bytes_of(normal * 0.5 + 0.5),
            "Position, world": bytes_of((position + (3.0, 6.0, 0.0)) / (10.0, 8.0, 2.6)),
            "Confidence, white is sure": grey(layers.confidence),
            "Entropy, white is unsure": grey(layers.entropy),
            "CryptoInstance, by coverage": cryptomatte_picture(planes, INSTANCES),
        },
        3,
        440,
    )


def cryptomatte_picture(planes: Planes, layer: str) -> Picture:
    """Each name in its own colour, mixed by its coverage of the pixel; black where nothing is."""
    found: dict[float, tuple[int, int, int]] = {}
    mixed = np.zeros((*planes[f"{layer}00.r"].shape, 3))
    for ids, coverage in ranks_of(planes, layer):
        for one in np.unique(ids[coverage > 0]).tolist():
            colour = found.setdefault(one, distinct_colour(len(found) + 1))
            mixed += np.where(ids == one, coverage, 0.0)[..., None] * np.array(colour) / 255
    return bytes_of(mixed)


def planes_of(path: Path) -> Planes:
    """The channels of an EXR file by name, [H, W] each."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def ranks_of(planes: Planes, layer: str) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """The six ranks of a Cryptomatte layer: ids and coverage, [H, W] each."""
    pairs = [
        (f"{layer}{rank:02d}.{ids}", f"{layer}{rank:02d}.{share}") for rank in range(3) for ids, share in ("rg", "ba")
    ]
    return [(planes[ids], planes[share]) for ids, share in pairs]


def instance_colours(result: LiftResult) -> dict[int, tuple[int, int, int]]:
    return {one.id: one.colour for one in result.instances}
