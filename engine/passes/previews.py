"""Pictures of baked views to look at: colour, classes, instances, and one sheet that shows a lift: a row per held-out
frame, from the photo to the lifted labels, and a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..scene import ClassTable, distinct_colour, evenly_spread
from ..scene.pixels import image_bytes
from .layers import PanopticLayers, encoded

Picture = NDArray[np.uint8]
"""uint8 [H, W, 3], RGB."""
Colour = tuple[int, int, int]

STUFF = (52, 54, 58)
"""The colour where there is no instance. It is dark, so that objects stand out."""
LINEAR_STEPS = (1 << 16) - 1
"""Steps of linear light in the table of bytes. The smallest byte is 20 steps wide."""
MOST_COLOURS = 1 << 16
"""Ids below this are looked up in a table."""
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
        write_atomically(path, image_bytes(picture))
    return paths


def preview_paths(folder: Path, frame: str) -> tuple[Path, Path, Path]:
    """Return the paths to which `write_previews` writes a frame's colour, classes and instances."""
    return folder / f"{frame}_colour.png", folder / f"{frame}_semantic.png", folder / f"{frame}_instance.png"


def colour_picture(layers: PanopticLayers) -> Picture:
    """Return the rendered colours as sRGB, as an image viewer shows them."""
    steps = layers.combined[..., :3] * np.float32(LINEAR_STEPS)
    steps += np.float32(0.5)
    return _encoded_bytes()[np.clip(steps, 0, LINEAR_STEPS, out=steps).astype(np.uint16)]


@cache
def _encoded_bytes() -> NDArray[np.uint8]:
    """Return the sRGB byte of every linear value k / LINEAR_STEPS, uint8 [LINEAR_STEPS + 1]."""
    return np.rint(encoded(np.arange(LINEAR_STEPS + 1) / LINEAR_STEPS) * 255).astype(np.uint8)


def semantic_picture(semantic: NDArray[np.int32], classes: ClassTable) -> Picture:
    """Draw the classes [H, W] in their colours; black for classes that are not in the table."""
    table = np.zeros((max(int(semantic.max(initial=0)), max(classes.ids, default=0)) + 1, 3), np.uint8)
    for category in classes.categories:
        table[category.id] = category.colour
    return table[semantic]


def instance_picture(instance: NDArray[np.int32], colours: Mapping[int, Colour] | None = None) -> Picture:
    """Draw instances [H, W] in one colour each (``distinct_colour`` unless in ``colours``), other pixels dark grey."""
    given = colours or {}
    if int(instance.max(initial=0)) >= MOST_COLOURS:
        ids, index = np.unique(instance, return_inverse=True)
        index = index.reshape(instance.shape)
    else:
        present, index = np.bincount(instance.ravel()), instance
        ids = np.arange(len(present)) * (present > 0)
    table = [STUFF if i == 0 else given.get(i, distinct_colour(i)) for i in ids.tolist()]
    return np.array(table, np.uint8).reshape(-1, 3)[index]


def panoptic_picture(
    semantic: NDArray[np.int32], instance: NDArray[np.int32], photo: Picture, classes: ClassTable,
    instance_colours: Mapping[int, Colour],
) -> Picture:  # fmt: skip
    """Draw classes and instances [H, W] over a photo: objects in their own colours, other pixels in those of their
    classes; black where there is no class and the photo is black."""
    labels, owned = semantic_picture(semantic, classes), instance > 0
    labels[owned] = instance_picture(instance, instance_colours)[owned]
    photo = photo.astype(np.float32)
    light = 0.35 + 0.9 * (photo @ LUMA)[..., None] / 255
    return np.clip(0.55 * light * labels + 0.45 * photo, 0, 255).astype(np.uint8)


def shaded(labels: Picture, photo: Picture) -> Picture:
    """Shade a picture of labels with the photo's brightness, and draw thin dark lines between labels."""
    luma = photo.astype(np.float32) @ LUMA / 255
    lit = labels * (0.6 + 0.4 * luma[..., None])
    edge = np.zeros(labels.shape[:2], bool)
    edge[:, 1:] |= (labels[:, 1:] != labels[:, :-1]).any(axis=-1)
    edge[1:] |= (labels[1:] != labels[:-1]).any(axis=-1)
    lit[edge] *= 0.45
    return np.rint(np.clip(lit, 0, 255)).astype(np.uint8)


MOST_ROWS = 8
"""Of more frames than this, a sheet shows as many, spread evenly."""
TILE_WIDTH, GAP, MARGIN, HEADING, LEGEND_LINE = 320, 6, 24, 34, 26
BACKGROUND, TEXT, FAINT = (24, 25, 28), (232, 232, 230), (150, 152, 156)


@dataclass(frozen=True, eq=False)
class SheetRow:
    """A row of the sheet, for the held-out frame ``name``: ``photo`` uint8 [H, W, 3], ``mask_classes`` int32 [H, W] of
    the input mask, and the baked layers, all of the same size."""

    name: str
    photo: Picture
    mask_classes: NDArray[np.int32]
    layers: PanopticLayers


def write_contact_sheet(
    path: Path, rows: Sequence[SheetRow], classes: ClassTable, instance_colours: Mapping[int, Colour] | None = None
) -> None:
    """Write a sheet with the columns photo, input mask, lifted classes, lifted instances. If there are more than eight
    ``rows``, eight evenly spaced ones are shown. Raises ValueError without rows, and OSError."""
    if not rows:
        raise ValueError("a contact sheet needs at least one view")
    rows = evenly_spread(rows, MOST_ROWS)
    tiles = [_tiles(row, classes, instance_colours) for row in rows]
    headings = list(dict.fromkeys(heading for row in tiles for heading in row))
    maps = [each for row in rows for each in (row.mask_classes, row.layers.semantic)]
    seen = sorted({one for each in maps for one in np.unique(each).tolist() if one in classes})
    width = 2 * MARGIN + len(headings) * (TILE_WIDTH + GAP) - GAP
    band = _blank(MARGIN + HEADING, width)
    for column, heading in enumerate(headings):
        _write(band, heading, (MARGIN + column * (TILE_WIDTH + GAP) + 2, MARGIN + HEADING - 12), TEXT)
    bands = [band]
    bands += [_band(row, name.name, headings, width) for row, name in zip(tiles, rows, strict=True)]
    bands.append(_legend(seen, classes, width))
    write_atomically(path, image_bytes(np.concatenate(bands)))


def _tiles(row: SheetRow, classes: ClassTable, colours: Mapping[int, Colour] | None) -> dict[str, Picture]:
    """Return the picture for each column. Labels are shrunk before they are shaded, so that no colours are mixed."""
    height, width = row.photo.shape[:2]
    size = (TILE_WIDTH, max(1, round(height * TILE_WIDTH / width)))
    photo = _resized(row.photo, size, labels=False)
    labels = {
        "input mask": semantic_picture(row.mask_classes, classes),
        "lifted classes": semantic_picture(row.layers.semantic, classes),
        "lifted instances": instance_picture(row.layers.instance, colours),
    }
    return {"photo": photo} | {
        heading: shaded(_resized(picture, size, labels=True), photo) for heading, picture in labels.items()
    }


def _band(tiles: Mapping[str, Picture], name: str, headings: Sequence[str], width: int) -> Picture:
    height = next(iter(tiles.values())).shape[0]
    band = _blank(height + GAP, width)
    for column, heading in enumerate(headings):
        if heading in tiles:
            left = MARGIN + column * (TILE_WIDTH + GAP)
            band[:height, left : left + TILE_WIDTH] = tiles[heading]
    strip = band[height - 22 : height, MARGIN : MARGIN + 12 + 9 * min(len(name), 30)]
    strip[:] = (strip * 0.35).astype(np.uint8)
    _write(band, name[:30], (MARGIN + 6, height - 6), TEXT, scale=0.42)
    return band


def _legend(class_ids: Sequence[int], classes: ClassTable, width: int) -> Picture:
    """Draw a swatch and a name for every class on the sheet. Names of things, which have instances, are brighter."""
    import cv2

    entries: list[tuple[int, int, int]] = []
    left, line = MARGIN, 0
    for class_id in class_ids:
        (text, _), _ = cv2.getTextSize(classes[class_id].name, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        needed = 22 + text + 22
        if left > MARGIN and left + needed > width - MARGIN:
            left, line = MARGIN, line + 1
        entries.append((class_id, left, line))
        left += needed
    band = _blank(14 + (line + 1) * LEGEND_LINE + MARGIN - 8, width)
    for class_id, left, line in entries:
        category, top = classes[class_id], 14 + line * LEGEND_LINE
        band[top : top + 14, left : left + 14] = category.colour
        _write(band, category.name, (left + 22, top + 12), TEXT if category.is_thing else FAINT)
    return band


def _blank(height: int, width: int) -> Picture:
    return np.full((height, width, 3), BACKGROUND, np.uint8)


def _resized(picture: Picture, size: tuple[int, int], labels: bool) -> Picture:
    import cv2

    smaller = size[0] < picture.shape[1]
    smooth = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST_EXACT if labels else smooth), np.uint8)


def _write(picture: Picture, text: str, at: tuple[int, int], colour: Colour, scale: float = 0.5) -> None:
    import cv2

    # OpenCV draws only ASCII.
    drawn = text.encode("ascii", "replace").decode()
    cv2.putText(picture, drawn, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
