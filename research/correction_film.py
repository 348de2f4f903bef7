"""A film of five stills: a lift seen from above while it is corrected, from what the engine made to the last edit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.corrections import CorrectedResult, read_corrected

Picture = NDArray[np.uint8]
STILLS = 5
WIDTH = 720
"""Pixels."""
CUT = 1.9
"""Metres above the floor at which the room is cut open."""
_LINE, _TEXT, _DOT = 26, 0.5, 1
_GROUND, _INK, _EDITED = (255, 255, 255), (30, 30, 30), (200, 0, 0)


@dataclass
class Film:
    """Takes a picture of the lift after each edit, and keeps the five that are farthest apart."""

    lift: Path
    pictures: list[Picture] = field(default_factory=list)

    def take(self, said: Sequence[str]) -> None:
        """Take a picture after these edits."""
        last = f": {said[-1]}" if said else ", as the engine made it"
        self.pictures.append(captioned(seen_from_above(read_corrected(self.lift)), f"{len(said)} edits{last}"))

    def write(self, folder: Path) -> list[Path]:
        """Write the stills as still_1.jpg and so on. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        places = np.unique(np.rint(np.linspace(0, len(self.pictures) - 1, STILLS)).astype(int))
        paths = []
        for number, place in enumerate(places.tolist(), start=1):
            path = folder / f"still_{number}.jpg"
            done, content = cv2.imencode(".jpg", self.pictures[place][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 55])
            assert done  # a picture of bytes
            path.write_bytes(content.tobytes())
            paths.append(path)
        return paths


def seen_from_above(result: CorrectedResult) -> Picture:
    """The points below `CUT`, with the longer side of the room across: objects in their colours with their names, red
    where they were edited, everything else in the photos' grey. uint8 [H, W, 3]."""
    points = result.points
    floor = np.percentile(points.xyz[:, 2], 2)
    low = np.flatnonzero(points.xyz[:, 2] < floor + CUT)
    order = low[np.argsort(points.xyz[low, 2], kind="stable")]  # the highest is painted last
    corners = np.percentile(points.xyz[order, :2], (0.5, 99.5), axis=0)
    axes = [0, 1] if np.ptp(corners[:, 0]) >= np.ptp(corners[:, 1]) else [1, 0]
    scale = WIDTH / max(float(np.ptp(corners[:, axes[0]])), 1e-3)
    height = max(int(np.ptp(corners[:, axes[1]]) * scale), 1)
    grey = points.rgb[order].mean(axis=1, keepdims=True) * 0.35 + 150
    colours = np.repeat(grey, 3, axis=1).astype(np.uint8)
    owner = points.instance_id[order]
    for one in result.instances:
        colours[owner == one.id] = one.colour
    picture = np.full((height, WIDTH, 3), _GROUND, np.uint8)

    def place(xyz: NDArray[np.floating]) -> NDArray[np.int64]:
        at = (xyz[..., axes] - corners[0, axes]) * scale
        return np.asarray(np.stack([at[..., 0], height - 1 - at[..., 1]], axis=-1), np.int64)

    where = place(points.xyz[order])
    for dx in range(-_DOT, _DOT + 1):
        for dy in range(-_DOT, _DOT + 1):
            column, row = (where + (dx, dy)).T
            inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < height)
            picture[row[inside], column[inside]] = colours[inside]
    made = [edit for edit in result.edits if not edit.undone]
    edited = {mark.id for edit in made for mark in edit.objects} | {new.id for edit in made for new in edit.made}
    edited |= {group.label for edit in made for group in edit.moved}
    for one in result.instances:
        if one.points > 100 or one.id in edited:
            name = one.name if one.class_name in one.name else f"{one.name} ({one.class_name})"
            _write(picture, name, place(np.array(one.centre)), _EDITED if one.id in edited else _INK)
    return picture


def captioned(picture: Picture, text: str) -> Picture:
    """The picture with a line of text below it."""
    strip = np.full((_LINE, picture.shape[1], 3), _GROUND, np.uint8)
    cv2.putText(strip, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, _TEXT, _INK, 1, cv2.LINE_AA)
    return np.concatenate([picture, strip])


def _write(picture: Picture, text: str, at: NDArray[np.int64], colour: tuple[int, int, int]) -> None:
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.36, 1)
    origin = int(at[0]) - width // 2, int(at[1])
    for ink, thick in (((255, 255, 255), 3), (colour, 1)):
        cv2.putText(picture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.36, ink, thick, cv2.LINE_AA)
