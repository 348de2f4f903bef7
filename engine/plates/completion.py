"""Completes a plane's texture where no photo saw it: its labels, its light, and its pattern."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt

from .leaving import Leaving
from .light import DARK, blocked_light, fit_light
from .texture import Mask, Texture

EDGE = 3
"""Texels at the edge of what photos saw that are not trusted: colours of other things bleed there."""
SMOOTH = 0.12
"""Metres, the standard deviation of the blur that separates light from pattern."""
RIM = 0.12
"""Metres around a hole in which the photos' colours replace the lift's, which have some of the objects'."""
LEAST_HOLE = 4e-4
"""Square metres, the smallest hole that is filled."""
LEAST_KNOWN = 50
"""Texels that must be known to complete the others."""
RECTANGLE = 0.85
"""Least share of a rectangle around a label that must have it, where seen, for the label to continue in it."""
SHADED, SHARP = 0.06, 0.3
"""Shares of light that objects block: from the first on, what is left of a shadow is evened out, up to twice as much;
at the second, shadows are sharp."""
DEEP = 0.25
"""Share of light that other things block, from which on a shadow says nothing about the light beside it."""
LEAST_CHANGE = 0.01
"""Least change of brightness (log) for which a texel that photos saw is drawn anew."""

Colours = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Completed:
    """A texture's ``colour`` [h, w, 3] and ``label`` [h, w] where it is drawn (``fill``), and its ``hole``."""

    colour: Colours
    label: NDArray[np.int32]
    fill: Mask
    hole: Mask


def complete(texture: Texture, leaving: Leaving, staying: NDArray[np.floating]) -> Completed | None:
    """Complete a texture of a plane that ``leaving`` stands on or hides, while other things with the points ``staying``
    [N, 3] keep their shadows. None if there is nothing to draw, or too little is known."""
    t, seen, hole = texture.texel, texture.seen, texture.hole()
    good = (distance_transform_edt(np.pad(seen, 1))[1:-1, 1:-1] > EDGE) & ~hole
    if hole.any():
        hole = hole | (seen & ~good & (_metres(hole, 1) <= EDGE + 3))
    below = texture.below(leaving)
    if (hole.sum() * t * t < LEAST_HOLE and not below.any()) or good.sum() < LEAST_KNOWN:
        return None
    label = completed_labels(texture.label, hole, good)
    level, blocked = np.log(texture.colour + DARK), blocked_light(texture, leaving.xyz, staying)
    light = fit_light(texture, level, label, good, blocked)
    ratio, most = level - light.expected - light.kept, (blocked.before - blocked.after).max(axis=-1)
    sharp = np.clip(most / SHARP, 0, 1)[..., None]
    here = smooth(ratio, good, SMOOTH / t) * (1 - sharp) + smooth(ratio, good, SMOOTH / 5 / t) * sharp
    clear = good & (most < SHADED) & (blocked.after.max(axis=-1) < DEEP)
    clear = clear if clear.sum() >= LEAST_KNOWN else good
    rest = harmonic(smooth(ratio, clear, SMOOTH / t), clear)
    pattern = copied_pattern(np.where(good[..., None], ratio - here, 0), good, hole, label, texture.label)
    evened = np.clip(most / SHADED - 1, 0, 1)[..., None]
    change = evened * (rest - here) - light.kept
    brighter = good & (np.abs(change).max(axis=-1) > LEAST_CHANGE)
    colour = np.where(brighter[..., None], np.exp(level + change) - DARK, texture.colour)
    guess = np.exp(light.expected + rest + pattern) - DARK
    colour = np.where(hole[..., None], guess, colour).clip(0, 1).astype(np.float32)
    fill = hole | brighter | (good & (_metres(hole, t) < RIM) if hole.any() else False)
    return Completed(colour, label, fill, hole) if fill.any() else None


def _metres(mask: Mask, texel: float) -> NDArray[np.float64]:
    """The distance of each texel from a mask."""
    return np.asarray(distance_transform_edt(~mask) * texel)


def completed_labels(known_label: NDArray[np.int32], hole: Mask, seen: Mask) -> NDArray[np.int32]:
    """Labels [h, w], continued into the hole. A label that fills its rectangle where photos saw it, such as a rug's,
    fills the rest of the rectangle. Elsewhere the hole gets the commonest label or, if all labels around it are that
    one, the nearest."""
    near = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    label = known_label[near[0], near[1]]
    counts = {int(one): int((seen & (known_label == one)).sum()) for one in np.unique(label)}
    ground = max(counts, key=counts.__getitem__)
    if counts[ground] == seen.sum():
        return label
    nearest, edge = label.copy(), binary_dilation(hole, iterations=4) & seen
    beside = [one for one in counts if one != ground and edge.any() and (known_label[edge] == one).mean() > 0.05]
    if beside:
        label[hole] = ground
    for kind in beside:
        own = cv2.morphologyEx(
            (seen & (known_label == kind)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)
        )
        y, x = np.nonzero(own)
        if len(x) < 30:
            continue
        corners = cv2.boxPoints(cv2.minAreaRect(np.stack([x, y], 1).astype(np.float32)))
        box = cv2.fillPoly(np.zeros(own.shape, np.uint8), [np.round(corners).astype(np.int32)], (1.0,)) > 0
        fits = (known_label[box & seen] == kind).mean() > RECTANGLE
        label[hole & (box if fits else nearest == kind)] = kind
    return label


def smooth(values: Colours, known: Mask, sigma: float) -> Colours:
    """``values`` blurred over what is known."""
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur(np.where(known[..., None], values, 0).astype(np.float32), (0, 0), sigma)
    return np.asarray(blurred / np.maximum(weight, 1e-4)[..., None])


def harmonic(values: Colours, known: Mask) -> Colours:
    """``values`` where they are known, elsewhere as smooth as can be (Laplace's equation), from coarse to fine."""
    sizes = [known.shape]
    while min(sizes[-1]) > 12:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    guess: Colours | None = None
    for h, w in reversed(sizes):
        weight = cv2.resize(known.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
        fixed = cv2.resize(
            np.where(known[..., None], values, 0).astype(np.float32), (w, h), interpolation=cv2.INTER_AREA
        )
        is_fixed = (weight > 0.5 if (h, w) != known.shape else known)[..., None]
        fixed = fixed / np.maximum(weight, 1e-6)[..., None]
        if guess is None:
            mean = (fixed * is_fixed).sum(axis=(0, 1)) / max(is_fixed.sum(), 1)
            now = np.where(is_fixed, fixed, mean)
        else:
            now = cv2.resize(guess, (w, h), interpolation=cv2.INTER_LINEAR)
        for _ in range(60):
            now = np.where(is_fixed, fixed, cv2.blur(now.astype(np.float32), (3, 3), borderType=cv2.BORDER_REPLICATE))
        guess = now.astype(np.float32)
    assert guess is not None
    return guess


ROUNDS, COMPARED, LOOKED_AT = 5, 500, 200
"""Shifts of a label's pattern, and the texels of a hole's edge and inside by which one is judged."""
ODD = 4.0
"""Patterns stronger than this many times their median are the traces of other things."""


def copied_pattern(
    pattern: Colours, known: Mask, wanted: Mask, label: NDArray[np.int32], before: NDArray[np.int32]
) -> Colours:
    """The pattern, copied into ``wanted`` from texels of the same label (``before``), by one shift after another. Each
    is the shift whose copy fits best to what surrounds the rest of the hole, among those that fill much of it (a greedy
    form of Shift-Map, Pritch et al. 2009)."""
    out = np.where(known[..., None], pattern, 0).astype(np.float32)
    size = np.abs(pattern).max(axis=-1)
    for kind in np.unique(label[wanted]).tolist():
        source, rest = known & (before == kind), wanted & (label == kind)
        if source.sum() < 200 or not rest.any():
            continue
        source &= size < ODD * np.median(size[source]) + 0.01
        source &= cv2.boxFilter(source.astype(np.float32), -1, (5, 5)) > 0.9
        valid = source.copy()
        for _ in range(ROUNDS):
            y, x = np.nonzero(rest)
            shift = _best_shift(out, pattern, source, valid, rest) if len(y) else None
            if shift is None:
                break
            fits = _within(source, y + shift[0], x + shift[1])
            y, x = y[fits], x[fits]
            out[y, x] = pattern[y + shift[0], x + shift[1]]
            rest[y, x], valid[y, x] = False, True
    return out


def _within(mask: Mask, y: NDArray[np.int64], x: NDArray[np.int64]) -> Mask:
    inside = (y >= 0) & (y < mask.shape[0]) & (x >= 0) & (x < mask.shape[1])
    inside[inside] = mask[y[inside], x[inside]]
    return inside


def _best_shift(out: Colours, pattern: Colours, source: Mask, valid: Mask, rest: Mask) -> tuple[int, int] | None:
    """The shift (rows, columns) whose copy fits best to what surrounds the ``rest`` of a hole and fills much of it."""
    random = np.random.default_rng(0)
    inside = np.argwhere(rest)
    few = inside[random.permutation(len(inside))[:LOOKED_AT]].T
    rim = np.argwhere(cv2.dilate(rest.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool) & valid)
    by, bx = rim[random.permutation(len(rim))[:COMPARED]].T
    step = max(4, max(rest.shape) // 24)
    best, shift = -np.inf, None
    for dy in range(-(rest.shape[0] // step) * step, rest.shape[0], step):
        for dx in range(-(rest.shape[1] // step) * step, rest.shape[1], step):
            share = _within(source, few[0] + dy, few[1] + dx).mean()
            if abs(dy) + abs(dx) < 6 or share < 0.15:
                continue
            fits = _within(source, by + dy, bx + dx)
            if fits.sum() < max(0.2 * len(by), 1):
                continue
            y, x = by[fits], bx[fits]
            gap = float(((pattern[y + dy, x + dx] - out[y, x]) ** 2).mean())
            if (score := float(share) / (gap + 1e-4)) > best:
                best, shift = score, (dy, dx)
    return shift
