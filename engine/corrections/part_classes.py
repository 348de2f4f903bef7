"""The class that the masks give each part of a split object, found without reading their pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import LiftFolder
from ..known_scene import read_known
from .replay import INNER, Replay

FITS = 0.5
"""Least intersection over union with a mask's rectangle at which the mask shows this part and little else."""


def class_of_parts(lift: Path, state: Replay, number: int, part: NDArray[np.integer]) -> dict[int, int]:
    """The class that most masks of an object give each ``part``, int [n] of its points in their order. A mask votes for
    the part whose points fill its rectangle, weighted by its pixels; a part without votes is left out.

    Raises PlgsError for a damaged list of the lift's frames.
    """
    folder = LiftFolder.open(lift)
    known = read_known(folder)
    if number not in state.objects or known is None:
        return {}
    cameras = {frame.name: frame.camera for frame in known.posed_frames(folder.request.scene)}
    xyz, numbers = state.points_of(number), np.unique(part).tolist()
    votes: dict[int, dict[int, float]] = {}
    for segment in state.objects[number].segments:
        camera = cameras.get(segment.frame)
        if camera is None or segment.class_id not in state.classes.thing_ids:
            continue
        rows, pixel, _ = camera.seen(xyz)
        place, shown = pixel / camera.size, part[rows]
        fits = [_overlap(place[shown == each], segment.rectangle) for each in numbers]
        if max(fits) >= FITS:
            own = votes.setdefault(numbers[int(np.argmax(fits))], {})
            own[segment.class_id] = own.get(segment.class_id, 0.0) + segment.pixels
    return {each: max(sorted(own), key=lambda kind: own[kind]) for each, own in votes.items()}


def _overlap(place: NDArray[np.float64], rectangle: tuple[float, float, float, float]) -> float:
    """Intersection over union of the rectangle around points [n, 2] with another one (left, top, right, bottom)."""
    if not len(place):
        return 0.0
    (left, top), (right, bottom) = np.percentile(place, INNER, axis=0)
    width = min(right, rectangle[2]) - max(left, rectangle[0])
    height = min(bottom, rectangle[3]) - max(top, rectangle[1])
    common = max(float(width), 0.0) * max(float(height), 0.0)
    other = (rectangle[2] - rectangle[0]) * (rectangle[3] - rectangle[1])
    return common / max(float((right - left) * (bottom - top)) + other - common, 1e-9)
