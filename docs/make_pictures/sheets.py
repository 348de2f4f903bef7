"""Sheets of pictures under their captions, and pictures before a ground."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray
from plgs.engine.passes.contact_sheet import BACKGROUND, TEXT

Picture = NDArray[np.uint8]
"""uint8 [H, W, 3], RGB."""
GAP, BAR = 6, 30


def tiled(tiles: Mapping[str, Picture], columns: int, width: int) -> Picture:
    """A sheet of pictures under their captions, each ``width`` pixels wide."""
    cells = [_captioned(caption, picture, width) for caption, picture in tiles.items()]
    height = max(len(cell) for cell in cells)
    rows = -(-len(cells) // columns)
    sheet = np.full((rows * (height + GAP) + GAP, columns * (width + GAP) + GAP, 3), BACKGROUND, np.uint8)
    for k, cell in enumerate(cells):
        top, left = GAP + k // columns * (height + GAP), GAP + k % columns * (width + GAP)
        sheet[top : top + len(cell), left : left + width] = cell
    return sheet


def _captioned(caption: str, picture: Picture, width: int) -> Picture:
    shape = (width, round(picture.shape[0] * width / picture.shape[1]))
    smooth = cv2.INTER_AREA if width < picture.shape[1] else cv2.INTER_CUBIC
    bar = np.full((BAR, width, 3), BACKGROUND, np.uint8)
    cv2.putText(bar, caption, (4, BAR - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.55, TEXT, 1, cv2.LINE_AA)
    return np.concatenate([bar, np.asarray(cv2.resize(picture, shape, interpolation=smooth), np.uint8)])


def before_ground(picture: NDArray[np.uint8], square: int = 20) -> Picture:
    """A picture with alpha before grey squares."""
    rows, columns = np.indices(picture.shape[:2]) // square
    return over(picture, np.where((rows + columns) % 2, 96.0, 70.0)[..., None])


def over(picture: NDArray[np.uint8], ground: NDArray[np.floating] | Picture) -> Picture:
    """A picture with alpha, uint8 [H, W, 4], before another one, [H, W, 3], or one colour."""
    alpha = picture[..., 3:] / 255.0
    return np.asarray(np.rint(alpha * picture[..., :3] + (1.0 - alpha) * ground), np.uint8)


def grey(values: NDArray[np.floating]) -> Picture:
    """0..1 as a grey picture."""
    return np.repeat(bytes_of(values)[..., None], 3, axis=-1)


def bytes_of(values: NDArray[np.floating]) -> Picture:
    """0..1 as bytes."""
    return np.asarray(np.rint(np.clip(values, 0.0, 1.0) * 255), np.uint8)
