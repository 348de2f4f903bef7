"""One picture that shows a lift: one row per held-out frame, from the photo to the lifted labels, and a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..scene import ClassTable
from .layers import PanopticLayers
from .previews import Colour, Picture, instance_picture, png_bytes, semantic_picture, shaded

MOST_ROWS = 8
TILE_WIDTH, GAP, MARGIN, HEADING, LEGEND_LINE = 320, 6, 24, 34, 26
BACKGROUND, TEXT, FAINT = (24, 25, 28), (232, 232, 230), (150, 152, 156)


@dataclass(frozen=True, eq=False)
class SheetRow:
    """One held-out frame: ``photo`` uint8 [H, W, 3], ``mask_classes`` int32 [H, W] of the input mask, and the baked
    layers, all of the same size."""

    name: str
    photo: Picture
    mask_classes: NDArray[np.int32]
    layers: PanopticLayers


def write_contact_sheet(
    path: Path,
    rows: Sequence[SheetRow],
    classes: ClassTable,
    instance_colours: Mapping[int, Colour] | None = None,
) -> None:
    """Write a sheet with the columns photo, input mask, lifted classes, lifted instances.

    If there are more than eight rows, eight are shown, spread evenly; pass only ``chosen`` frames to save work. Raises
    ValueError without rows, and OSError if the file cannot be written.
    """
    if not rows:
        raise ValueError("a contact sheet needs at least one view")
    rows = [rows[k] for k in chosen(len(rows))]
    tiles = [_tiles(row, classes, instance_colours) for row in rows]
    headings = list(dict.fromkeys(heading for row in tiles for heading in row))
    seen = sorted({c for row in rows for m in _class_maps(row) for c in np.unique(m).tolist() if c in classes})
    width = 2 * MARGIN + len(headings) * (TILE_WIDTH + GAP) - GAP
    bands = [_headings(headings, width)]
    bands += [_band(row, name.name, headings, width) for row, name in zip(tiles, rows, strict=True)]
    bands.append(_legend(seen, classes, width))
    write_atomically(path, png_bytes(np.concatenate(bands)))


def chosen(count: int) -> list[int]:
    """The numbers of the frames, of ``count``, that a sheet shows: all up to eight, otherwise eight spread evenly."""
    if count <= MOST_ROWS:
        return list(range(count))
    return [round(k * (count - 1) / (MOST_ROWS - 1)) for k in range(MOST_ROWS)]


def _class_maps(row: SheetRow) -> list[NDArray[np.int32]]:
    return [row.mask_classes, row.layers.semantic]


def _tiles(row: SheetRow, classes: ClassTable, colours: Mapping[int, Colour] | None) -> dict[str, Picture]:
    """The picture under each heading. Labels are shrunk before they are shaded, so that no colours are mixed."""
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


def _headings(headings: Sequence[str], width: int) -> Picture:
    band = _blank(MARGIN + HEADING, width)
    for column, heading in enumerate(headings):
        _write(band, heading, (MARGIN + column * (TILE_WIDTH + GAP) + 2, MARGIN + HEADING - 12), TEXT)
    return band


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
    """A swatch and a name for every class on the sheet. Names of things, which have instances, are brighter."""
    places: list[tuple[int, int, int]] = []
    left, line = MARGIN, 0
    for class_id in class_ids:
        needed = 22 + _text_width(classes[class_id].name) + 22
        if left > MARGIN and left + needed > width - MARGIN:
            left, line = MARGIN, line + 1
        places.append((class_id, left, line))
        left += needed
    band = _blank(14 + (line + 1) * LEGEND_LINE + MARGIN - 8, width)
    for class_id, left, line in places:
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

    # OpenCV draws ASCII only.
    drawn = text.encode("ascii", "replace").decode()
    cv2.putText(picture, drawn, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


def _text_width(text: str) -> int:
    import cv2

    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    return int(width)


def first_row(sheet: Path, caption: str) -> Picture:
    """The first frame's row of a written sheet, uint8 [H, W, 3], under a caption. Raises OSError."""
    import cv2

    stored = cv2.imread(str(sheet))
    if stored is None:
        raise OSError(f"{sheet} is not a picture")
    picture = np.asarray(stored, np.uint8)[..., ::-1]
    top = MARGIN + HEADING
    tiles = picture[top:, MARGIN : MARGIN + TILE_WIDTH]
    gap = (tiles == np.array(BACKGROUND, np.uint8)).all(axis=(1, 2))
    height = int(gap.argmax()) if gap.any() else len(tiles)
    band = _blank(HEADING, picture.shape[1])
    _write(band, caption, (MARGIN + 2, HEADING - 12), TEXT)
    return np.concatenate([band, picture[top : top + height]])
