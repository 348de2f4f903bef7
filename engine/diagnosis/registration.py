"""Does depth lie on the colour images? Depth's edges are laid over the picture's gradients, moved and scaled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .looks import Look
from .photos import Photo

Floats = NDArray[np.float64]

_MOST = 32
_WIDTH = 160
_FARTHEST = 0.12
"""Largest shift looked for, in shares of the width."""
_SCALES = (1.0, 0.97, 1.03, 0.94, 1.06, 0.91, 1.1, 0.88, 1.14, 0.84, 1.19, 0.8, 1.25)
_JUMP = 0.06
"""Relative step of depth from one pixel to the next, beyond what the surface's slant makes, that is an edge."""
_LEAST_EDGES = 60
_LEAST_LOOKS = 5
_AHEAD, _APART = 2.0, 0.1
"""Metres: looks are of another place where the points so far ahead of their cameras are so far apart."""


class Registration(NamedTuple):
    """Where depth's edges fit the pictures best: an edge at place p (shares of the picture) belongs to
    (p - 0.5) * ``scale`` + 0.5 + ``shift``.

    ``gain``: how much better the pictures' gradients fit there than where depth lies now, in standard deviations of
    the gradient; ``certainty``: that over its standard error among the frames. ``frames``: how many had edges.
    """

    scale: float
    shift: tuple[float, float]
    gain: float
    certainty: float
    frames: int


def measure_registration(looks: list[Look], photos: dict[int, Photo]) -> Registration | None:
    """Find the scale and shift that bring depth's edges onto those of the pictures; None with too few edges."""
    chosen = _distinct([look for look in looks if look.number in photos])
    pairs = [(depth_edges(look.depth), contrast(photos[look.number].grey)) for look in chosen]
    pairs = [(edges, picture) for edges, picture in pairs if len(edges) >= _LEAST_EDGES]
    if len(pairs) < _LEAST_LOOKS:
        return None
    coarse = max((_coarse(pairs, scale) for scale in _SCALES), key=lambda found: found[0])
    scale, shift = _refined(pairs, coarse[1], coarse[2])
    gains = _fits(pairs, scale, shift) - _fits(pairs, 1.0, (0.0, 0.0))
    error = max(float(gains.std(ddof=1)) / np.sqrt(len(gains)), 1e-6)
    return Registration(scale, shift, float(gains.mean()), float(gains.mean()) / error, len(pairs))


def _distinct(looks: list[Look]) -> list[Look]:
    """At most 32 looks spread over the recording, each of another place: the same view twice tells nothing more."""
    rows = np.unique(np.linspace(0, len(looks) - 1, min(len(looks), _MOST)).round().astype(int))
    kept: list[Look] = []
    seen: list[Floats] = []
    for look in (looks[row] for row in rows):
        pose = look.camera.camera_to_world
        aim = pose[:3, 3] + _AHEAD * pose[:3, 2]
        if all(np.linalg.norm(aim - other) > _APART for other in seen):
            kept.append(look)
            seen.append(aim)
    return kept


def depth_edges(depth: NDArray[np.float32]) -> Floats:
    """Where depth jumps between two pixels, float64 [N, 2] in shares of the picture."""
    height, width = depth.shape
    found = []
    for axis in (0, 1):
        values = np.moveaxis(depth, axis, 0).astype(np.float64)
        before, one, other, after = values[:-3], values[1:-2], values[2:-1], values[3:]
        known = (before > 0.0) & (one > 0.0) & (other > 0.0) & (after > 0.0)
        slant = np.minimum(np.abs(one - before), np.abs(after - other))
        jumps = known & (np.abs(other - one) - 3.0 * slant > _JUMP * np.minimum(one, other))
        along, across = np.nonzero(jumps)
        places = [(along + 2.0) / len(values), (across + 0.5) / values.shape[1]]
        found.append(np.stack(places if axis == 1 else places[::-1], -1))
    return np.concatenate(found)


def contrast(grey: NDArray[np.uint8]) -> Floats:
    """How strong a picture's edges are at each pixel, of mean 0 and deviation 1; strong ones do not outweigh all."""
    import cv2

    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.8)
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    strength = np.sqrt(np.sqrt(x * x + y * y)).astype(np.float64)
    return (strength - strength.mean()) / max(float(strength.std()), 1e-6)


def _coarse(pairs: list[tuple[Floats, Floats]], scale: float) -> tuple[float, float, tuple[float, float]]:
    """The best fit at a scale, the scale, and the shift, over all shifts on a grid 160 wide."""
    import cv2

    height = max(8, round(_WIDTH * pairs[0][1].shape[0] / pairs[0][1].shape[1]))
    total = np.zeros((height, _WIDTH))
    for edges, picture in pairs:
        small = cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA)
        places = ((edges - 0.5) * scale + 0.5) * (_WIDTH, height)
        columns, rows = np.floor(places).astype(np.int64).T
        inside = (columns >= 0) & (columns < _WIDTH) & (rows >= 0) & (rows < height)
        drawn = np.zeros((height, _WIDTH))
        np.add.at(drawn, (rows[inside], columns[inside]), 1.0)
        total += np.fft.irfft2(np.fft.rfft2(small) * np.conj(np.fft.rfft2(drawn)), (height, _WIDTH)) / len(edges)
    reach = int(_FARTHEST * _WIDTH)
    steps = np.arange(-reach, reach + 1)
    window = total[np.ix_(steps, steps)]
    row, column = np.unravel_index(int(window.argmax()), window.shape)
    return float(window[row, column]) / len(pairs), scale, (float(steps[column]) / _WIDTH, float(steps[row]) / height)


def _refined(
    pairs: list[tuple[Floats, Floats]], scale: float, shift: tuple[float, float]
) -> tuple[float, tuple[float, float]]:
    """The best fit nearby, to a tenth of a pixel of a picture 320 wide."""
    best = np.array([scale, *shift])
    for step in (1 / 160, 1 / 320, 1 / 640, 1 / 1280, 1 / 3200):
        moves = [np.array(m) * (2.0 * step, step, step) for m in np.ndindex(3, 3, 3)]
        candidates = [best + move - np.array([2.0 * step, step, step]) for move in moves]
        fits = [float(_fits(pairs, c[0], (c[1], c[2])).mean()) for c in candidates]
        best = candidates[int(np.argmax(fits))]
    return float(best[0]), (float(best[1]), float(best[2]))


def _fits(pairs: list[tuple[Floats, Floats]], scale: float, shift: tuple[float, float]) -> Floats:
    """The mean contrast of the pictures under depth's edges, one value a frame; 0 for edges outside."""
    import cv2

    values = []
    for edges, picture in pairs:
        height, width = picture.shape
        places = (((edges - 0.5) * scale + 0.5 + shift) * (width, height) - 0.5).astype(np.float32)
        under = cv2.remap(
            picture.astype(np.float32), places[None, :, 0], places[None, :, 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=(0.0,),
        )  # fmt: skip
        values.append(float(under.mean()))
    return np.array(values)
