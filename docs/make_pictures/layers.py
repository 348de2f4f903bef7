"""The layers of a baked frame, and a mask beside what was lifted of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from plgs.engine.passes.exr import read_exr
from plgs.engine.passes.previews import colour_picture, instance_picture, semantic_picture, shaded
from plgs.engine.scene import distinct_colour
from plgs.plgs_blender.pass_nodes import INSTANCES
from plgs.plgs_blender.results import LiftResult

from .sheets import Picture, bytes_of, grey, tiled
from .shot import CAMERA, SHOT_FRAME

MASK_FRAME = "0016"
"""Held out, and its mask has what lifting mends: holes, a vase that is a bin, pieces of windows."""


def mask_picture(result: LiftResult) -> Picture:
    """A held-out frame: photo, the machine mask, and what was lifted, which saw neither."""
    frame = next(each for each in result.scene.frames if each.name == MASK_FRAME)
    photo, mask = frame.read_colour(frame.size), frame.mask(frame.size)
    layers = read_exr(result.passes[MASK_FRAME])
    return tiled(
        {
            f"photo, frame {MASK_FRAME}": photo,
            "its machine mask (black: none)": shaded(semantic_picture(mask.class_map(), result.classes), photo),
            "lifted classes": shaded(semantic_picture(layers.semantic, result.classes), photo),
            "lifted instances": shaded(instance_picture(layers.instance, instance_colours(result)), photo),
        },
        2,
        560,
    )


def layers_picture(result: LiftResult) -> Picture:
    """All layers of one frame of the moving camera."""
    import OpenEXR

    path = result.shots[f"{CAMERA}.{SHOT_FRAME:04d}"]
    layers = read_exr(path)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = {name: channel.pixels for name, channel in file.channels().items()}
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


def cryptomatte_picture(planes: Mapping[str, NDArray[np.float32]], layer: str) -> Picture:
    """Each name in a colour of its own, mixed by its coverage of the pixel; black where nothing is."""
    found: dict[float, tuple[int, int, int]] = {}
    mixed = np.zeros((*planes[f"{layer}00.r"].shape, 3))
    for rank in range(3):
        for name, share in ("rg", "ba"):
            ids, coverage = planes[f"{layer}{rank:02d}.{name}"], planes[f"{layer}{rank:02d}.{share}"]
            for one in np.unique(ids[coverage > 0]).tolist():
                colour = found.setdefault(one, distinct_colour(len(found) + 1))
                mixed += np.where(ids == one, coverage, 0.0)[..., None] * np.array(colour) / 255
    return bytes_of(mixed)


def instance_colours(result: LiftResult) -> dict[int, tuple[int, int, int]]:
    return {one.id: one.colour for one in result.instances}
