"""Pictures of a baked view for people: colour, classes, instances."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..scene import ClassTable, distinct_colour
from .layers import PanopticLayers, encoded

Picture = NDArray[np.uint8]
"""uint8 [H, W, 3], RGB."""
Colour = tuple[int, int, int]

STUFF = (52, 54, 58)
"""The colour where there is no instance. It is dark, so that objects stand out."""
LINEAR_STEPS = (1 << 16) - 1
"""Steps of linear light in the table of bytes. The smallest byte is 20 steps wide."""
MOST_COLOURS = 1 << 16
"""Each id below this has a place in a table."""
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)


def write_previews(
    folder: Path,
    frame: str,
    layers: PanopticLayers,
    classes: ClassTable,
    instance_colours: Mapping[int, Colour] | None = None,
) -> tuple[Path, Path, Path]:
    """Write ``<frame>_colour.png``, ``<frame>_semantic.png``, ``<frame>_instance.png`` and return their paths. Raises
    OSError if a file cannot be written."""
    pictures = (
        colour_picture(layers),
        semantic_picture(layers.semantic, classes),
        instance_picture(layers.instance, instance_colours),
    )
    paths = preview_paths(folder, frame)
    for path, picture in zip(paths, pictures, strict=True):
        write_atomically(path, png_bytes(picture))
    return paths


def preview_paths(folder: Path, frame: str) -> tuple[Path, Path, Path]:
    """The paths to which `write_previews` writes a frame's colour, classes and instances."""
    return folder / f"{frame}_colour.png", folder / f"{frame}_semantic.png", folder / f"{frame}_instance.png"


def colour_picture(layers: PanopticLayers) -> Picture:
    """The rendered colours as an image viewer shows them."""
    steps = layers.combined[..., :3] * np.float32(LINEAR_STEPS)
    steps += np.float32(0.5)
    return _encoded_bytes()[np.clip(steps, 0, LINEAR_STEPS, out=steps).astype(np.uint16)]


@cache
def _encoded_bytes() -> NDArray[np.uint8]:
    """The sRGB byte of every linear value k / LINEAR_STEPS."""
    return np.rint(encoded(np.arange(LINEAR_STEPS + 1) / LINEAR_STEPS) * 255).astype(np.uint8)


def semantic_picture(semantic: NDArray[np.int32], classes: ClassTable) -> Picture:
    """The colours of the classes; black for classes that are not in the table."""
    table = np.zeros((max(int(semantic.max(initial=0)), max(classes.ids, default=0)) + 1, 3), np.uint8)
    for category in classes.categories:
        table[category.id] = category.colour
    return table[semantic]


def instance_picture(instance: NDArray[np.int32], colours: Mapping[int, Colour] | None = None) -> Picture:
    """One colour per instance (``distinct_colour`` of its id unless ``colours`` has one), dark grey elsewhere."""
    given = colours or {}
    if int(instance.max(initial=0)) >= MOST_COLOURS:
        ids, place = np.unique(instance, return_inverse=True)
        place = place.reshape(instance.shape)
    else:
        present, place = np.bincount(instance.ravel()), instance
        ids = np.arange(len(present)) * (present > 0)
    table = [STUFF if i == 0 else given.get(i, distinct_colour(i)) for i in ids.tolist()]
    return np.array(table, np.uint8).reshape(-1, 3)[place]


def panoptic_picture(layers: PanopticLayers, classes: ClassTable, instance_colours: Mapping[int, Colour]) -> Picture:
    """Classes and instances over the rendered colours: objects in their own colours, the rest in those of its classes;
    black where nothing was rendered."""
    labels = semantic_picture(layers.semantic, classes)
    owned = layers.instance > 0
    labels[owned] = instance_picture(layers.instance, instance_colours)[owned]
    photo = colour_picture(layers).astype(np.float32)
    light = 0.35 + 0.9 * (photo @ LUMA)[..., None] / 255
    return np.clip(0.55 * light * labels + 0.45 * photo, 0, 255).astype(np.uint8)


def shaded(labels: Picture, photo: Picture) -> Picture:
    """A label picture in the light of the photo, with thin dark lines between labels."""
    luma = photo.astype(np.float32) @ LUMA / 255
    lit = labels * (0.6 + 0.4 * luma[..., None])
    edge = np.zeros(labels.shape[:2], bool)
    edge[:, 1:] |= (labels[:, 1:] != labels[:, :-1]).any(axis=-1)
    edge[1:] |= (labels[1:] != labels[:-1]).any(axis=-1)
    lit[edge] *= 0.45
    return np.rint(np.clip(lit, 0, 255)).astype(np.uint8)


def png_bytes(picture: Picture) -> bytes:
    """An RGB picture as PNG. Raises ValueError if it cannot be encoded."""
    import cv2

    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not done:
        raise ValueError(f"cannot encode a picture of shape {picture.shape} as PNG")
    return data.tobytes()
