"""Inspect a picture's values before they become masks or ids, to detect what other programs did when they saved it.

A mask of one object may have soft edges, JPEG noise, or a network's probabilities instead of two values. A picture of
ids may have been resized with a filter, which averages neighbouring ids. Palettes may differ between frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError, reading
from ..gates import open_plain

_MIXED = 0.12
"""Fraction of the edge pixels whose value lies between those of both neighbours. The sample's masks reach 0.02; resized
with a filter or saved as JPEG, they have 0.19 to 0.5."""
_LEAST_EDGES = 100
_MOST_COLOURS = 4096
_BLACK = b"\0\0\0"
_PALETTE_FIX = "Save the ids themselves as grey values, or all frames with one palette."


def are_mixed(values: NDArray[Any], every: int = 1) -> bool | None:
    """Whether values [H, W] change gradually at edges, as ids never do; None if there are too few edges to decide. Only
    every ``every``-th row and column is inspected."""
    edges = between = 0
    for lines in (values[::every], values.T[::every]):
        before, here, after = lines[:, :-2], lines[:, 1:-1], lines[:, 2:]
        edges += int((before != after).sum())
        between += int((((before < here) & (here < after)) | ((before > here) & (here > after))).sum())
    return between > _MIXED * edges if edges >= _LEAST_EDGES else None


def inside(values: NDArray[Any], path: Path) -> NDArray[np.bool_]:
    """Return the pixels of the object in a mask [H, W] of one object, bool [H, W]. These are the values other than 0 if
    there are only two, else those above half of the range, whether of probabilities, logits, 8 or 16 bits. Raises
    PlgsError if the values look like several ids."""
    if values.dtype.kind == "b" or not values.size:
        return values.astype(np.bool_)
    if values.dtype.kind == "f":
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    least, most = values.min(), values.max()
    if values.dtype.kind == "f" and (least < 0.0 or most <= 1.5):
        return values > (0.0 if least < 0.0 else 0.5)
    if bool(((values == 0) | (values == most)).all()):
        return values != 0
    half = 50 if most == 100 else 127 if most < 256 else 32767  # per cent, or 8 or 16 bits
    if most <= half and not are_mixed(values):
        what = f"this is not the mask of one object: it has values up to {most}"
        raise PlgsError("not-one-object", what, path, "Save one object as 0 and 255, or all as a picture of ids.")
    return values > half


def checked_ids(ids: NDArray[Any], path: Path) -> NDArray[Any]:
    """Return ``ids`` [H, W] unchanged. Raises PlgsError if a filter has mixed them."""
    if are_mixed(ids, every=4):
        fix = "Resize ids with nearest neighbour, and save them as PNG."
        raise PlgsError("mixed-ids", "ids are mixed at edges, as after a resize with a filter, or in a JPEG", path, fix)
    return ids


def numbers_of_colours(paths: Sequence[Path], is_class: bool = False) -> dict[bytes, int] | None:
    """Number the colours of PNGs' palettes, 0 for black, if the palettes differ; else return None. Raises PlgsError if
    colours cannot be ids: if ``is_class`` (indices are classes), if black is missing, or if some are grey."""
    palettes = {path: palette for path in paths if (palette := palette_of(path))}
    longest = max(palettes.values(), key=len, default=b"")
    if all(longest.startswith(each) for each in palettes.values()):
        return None
    colours = {each[i : i + 3] for each in palettes.values() for i in range(0, len(each), 3)}
    if is_class or len(palettes) < len(paths) or _BLACK not in colours or len(colours) > _MOST_COLOURS:
        what = "palettes differ between the masks, so an index means something else in each"
        raise PlgsError("palettes-differ", what, paths[0], _PALETTE_FIX)
    return {colour: number for number, colour in enumerate(sorted(colours))}


def by_colour(indices: NDArray[np.int32], path: Path, numbers: Mapping[bytes, int]) -> NDArray[np.int32]:
    """Return the ``numbers`` of the colours that ``indices`` [H, W] have in a PNG's own palette, int32 [H, W]."""
    palette = palette_of(path)
    table = [numbers[palette[i : i + 3]] for i in range(0, len(palette), 3)]
    return np.array(table + [0] * (256 - len(table)), np.int32)[indices]  # indices beyond the palette are void


def palette_of(path: Path) -> bytes:
    """Return the colours of a PNG's palette, 3 bytes each; b"" without one. Raises PlgsError if it is unreadable."""
    with reading(path), open_plain(path) as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            length = int.from_bytes(head[:4], "big")
            if head[4:] == b"PLTE" and length <= 768:
                return file.read(length)
            file.seek(length + 4, 1)
    return b""
