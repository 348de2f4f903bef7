"""Complete a plane's texture where no photo saw it: its labels and its light."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt

from .leaving import Leaving
from .light import DARK, blocked_light, fit_light
from .texture import Mask, Texture

# Sizes were chosen on six objects of docs/clean-plates.md's table: the first four, the armchair and the dishes.
EDGE = 3
"""Texels at the edge of what photos saw that are not trusted: colours of other things bleed there."""
SMOOTH = 0.12
"""Metres, the standard deviation of the blur that separates light from pattern."""
RIM = 0.12
"""Metres around a hole in which the photos' colours replace the lift's, which have some of the objects'."""
LEAST_HOLE = 4e-4
"""Square metres, the smallest hole that is filled: one cell (`corrections/fills`)."""
LEAST_KNOWN = 50
"""Texels that must be known to complete the others."""
RECTANGLE = 0.85
"""Least share of a rectangle around a label that must have it, where seen, for the label to continue in it."""
SHADED, SHARP = 0.06, 0.3
"""Shares of light that objects block: from the first on, what is left of a shadow is evened out, up to twice as much;
at the second, shadows are sharp."""
DEEP = 0.25
"""Share of light that other things block, from which on a shadow says nothing about the light beside it."""
FAINTER = 1 / 4
"""How much less a blur counts than one half as wide (1/64: the ring around the chair is 0.7 dB worse)."""
FADED = 0.2
"""Metres around a hole. In sharp shadows, what photos saw fades into the guess over them."""
EXTREME = 1
"""Per cent of what photos saw that is darker or brighter than anything that is guessed: light that is continued over a
large hole could become anything (the television's hole: 1.7 dB)."""
LEAST_CHANGE = 0.01
"""Least change of brightness (log) for which a texel that photos saw is drawn anew: 1 %, which nobody sees."""

Colours = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Completed:
    """A completed texture: ``colour`` [h, w, 3], ``label``, ``fill`` (where it is drawn) and ``hole``, [h, w] each."""

    colour: Colours
    label: NDArray[np.int32]
    fill: Mask
    hole: Mask


def complete(texture: Texture, leaving: Leaving, staying: NDArray[np.floating]) -> Completed | None:
    """Complete the texture of a plane that ``leaving`` stands on or hides; other things, with the points ``staying``
    [N, 3], keep their shadows. Returns None if nothing has to be drawn, or if photos show too little."""
    t, seen, hole = texture.texel, texture.seen, texture.hole()
    good = (distance_transform_edt(np.pad(seen, 1))[1:-1, 1:-1] > EDGE) & ~hole
    if hole.any():
        hole = hole | (seen & ~good & (_metres(hole, 1) <= EDGE + 3))
    below = texture.below(leaving)
    nothing = hole.sum() * t * t < LEAST_HOLE and not (below | (good & texture.poorly)).any()
    if nothing or good.sum() < LEAST_KNOWN:
        return None
    label = completed_labels(texture.label, hole, good)
    level, blocked = np.log(texture.colour + DARK), blocked_light(texture, leaving.xyz, staying)
    limits = np.percentile(level[good], (EXTREME, 100 - EXTREME), axis=0)
    bands = level_bands(level, good) if texture.plane.is_wall else np.float32(0)
    level = level - bands
    light = fit_light(texture, level, label, good, blocked)
    ratio, most = level - light.expected - light.kept, (blocked.before - blocked.after).max(axis=-1)
    sharp = np.clip(most / SHARP, 0, 1)[..., None]
    here = spread(ratio, good, SMOOTH / t) * (1 - sharp) + spread(ratio, good, SMOOTH / 5 / t) * sharp
    clear = good & (most < SHADED) & (blocked.after.max(axis=-1) < DEEP)
    rest = spread(ratio, clear if clear.sum() >= LEAST_KNOWN else good, SMOOTH / t)
    evened = np.clip(most / SHADED - 1, 0, 1)[..., None]
    change = evened * (rest - here) - light.kept
    brighter = good & (np.abs(change).max(axis=-1) > LEAST_CHANGE)
    colour = np.where(brighter[..., None], np.exp(level + bands + change) - DARK, texture.colour)
    guess = np.exp((light.expected + rest + bands).clip(*limits)) - DARK
    faded = np.maximum(hole[..., None], sharp * np.clip(1 - _metres(hole, t) / FADED, 0, 1)[..., None])
    colour = (faded * guess + (1 - faded) * colour).clip(0, 1).astype(np.float32)
    fill = hole | brighter | (good & texture.poorly) | (good & (_metres(hole, t) < RIM) if hole.any() else False)
    return Completed(colour, label, fill, hole) if fill.any() else None


def level_bands(level: Colours, good: Mask) -> Colours:
    """Return how the log brightness changes over a plane's rows, which on a wall are level, float32 [h, 1, 3]: the sum
    of the median changes from row to row. It continues skirting boards and changes of paint."""
    pairs = good[1:] & good[:-1]
    steps = np.zeros((len(good), 3), np.float32)
    for row in np.flatnonzero(pairs.sum(axis=1) >= LEAST_KNOWN // 2):
        steps[row + 1] = np.median((level[row + 1] - level[row])[pairs[row]], axis=0)
    return np.cumsum(steps, axis=0)[:, None]


def _metres(mask: Mask, texel: float) -> NDArray[np.float64]:
    """Return the distance of each texel from a mask [h, w], float64 [h, w] in metres."""
    return np.asarray(distance_transform_edt(~mask) * texel)


def completed_labels(known_label: NDArray[np.int32], hole: Mask, seen: Mask) -> NDArray[np.int32]:
    """Return the labels [h, w] of a texture, continued into the ``hole`` from the nearest texel that was ``seen``. A
    label that fills its rectangle, as a rug does, fills that in the hole too; the commonest label fills the rest."""
    label = known_label[tuple(distance_transform_edt(~seen, return_distances=False, return_indices=True))]
    kinds, counts = np.unique(known_label[seen], return_counts=True)
    edge = binary_dilation(hole, iterations=4) & seen
    for kind in kinds[(counts < counts.max()) & np.isin(kinds, known_label[edge])].tolist():
        own = (seen & (known_label == kind)).astype(np.uint8)
        own = cv2.morphologyEx(own, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        if own.any():
            corners = cv2.boxPoints(cv2.minAreaRect(np.argwhere(own)[:, ::-1].astype(np.float32)))
            box = cv2.fillPoly(np.zeros_like(own), [np.rint(corners).astype(np.int32)], (1.0,)) > 0
            if (known_label[box & seen] == kind).mean() > RECTANGLE:
                label[hole & (label == kind)] = kinds[counts.argmax()]
                label[hole & box] = kind
    return label


def spread(values: Colours, known: Mask, sigma: float) -> Colours:
    """Blur ``values`` [h, w, 3] by ``sigma`` texels where they are ``known``, and continue them elsewhere. The result
    sums blurs, each twice as wide as the one before; a blur counts only where narrower ones hardly reach."""
    total, weight = np.zeros_like(values), np.full(known.shape, 1e-12, np.float32)
    shown = np.where(known[..., None], values, 0).astype(np.float32)
    for octave in range(1 + max(0, int(np.log2(max(known.shape) / sigma)))):
        total += FAINTER**octave * cv2.GaussianBlur(shown, (0, 0), sigma * 2**octave)
        weight += FAINTER**octave * cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma * 2**octave)
    return np.asarray(total / weight[..., None])
