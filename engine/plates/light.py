"""Estimate the light on a plane, and how much of it removed objects kept away."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from .texture import Mask, Texture

# Chosen with the prototype, on six objects of the sample. Where varying a value was measured, its comment says so.
DARK = 0.02
"""Added to colours before the logarithm."""
DIRECTIONS, PLACES_APART = 64, 0.06
"""Rays from each place, and metres between places."""
STEP, FARTHEST, BLOCK = 0.05, 2.0, 0.08
"""Metres of a step along a ray, of a whole ray, and of the side of a block that stops rays."""
DARKEST = 0.8
"""Share of the light that is lost where objects block all of it: they reflect the rest. With 0.6 or 0.95, the holes of
the sample's sofa and coffee table change by at most 0.1 dB."""
SAMPLES, ROUNDS, USUAL = 6000, 4, 0.08
"""Texels that the light is fitted to, rounds of the fit, and residuals (log) beyond which a texel counts less."""
STRONGEST = 1.0
"""The largest effect (exponent) of light that is kept away on encoded colours; all of it would be 1 / 2.2. It
bounds the fit where little of a plane was seen. The sample's sofa and coffee table do not reach it."""

Colours = NDArray[np.float32]


class Blocked(NamedTuple):
    """The shares of light that things keep from each texel, float32 [h, w, 2]: of light from everywhere, and of light
    from above; ``before`` and ``after`` the removal."""

    before: Colours
    after: Colours


def blocked_light(texture: Texture, leaving: NDArray[np.floating], staying: NDArray[np.floating]) -> Blocked:
    """Return the light that things with the points ``leaving`` [N, 3] and things with the points ``staying`` block."""
    t, (h, w) = texture.texel, texture.seen.shape
    rows, columns = (max(2, int(np.ceil(side * t / PLACES_APART))) for side in (h, w))
    v, u = (np.arange(count) + 0.5 for count in (rows, columns))
    places = np.stack(np.meshgrid(u * w * t / columns, v * h * t / rows), axis=-1).reshape(-1, 2)
    start, normal = texture.plane.world(texture.low + places), texture.plane.axes[2]
    ways = _hemisphere() @ texture.plane.axes
    weights = np.stack([ways @ normal, (ways @ normal) * np.maximum(ways[:, 2], 0) ** 2], axis=1)
    stopped = [_stopped(start, ways, solid) for solid in (leaving, staying)]
    weights /= np.maximum(weights.sum(axis=0), 1e-9)  # no light from above reaches a ceiling
    shares = (hits @ weights for hits in (stopped[0] | stopped[1], stopped[1]))
    shapes = (share.reshape(rows, columns, 2).astype(np.float32) for share in shares)
    return Blocked(*(np.asarray(cv2.resize(each, (w, h), interpolation=cv2.INTER_LINEAR)) for each in shapes))


def _stopped(start: NDArray[np.float64], ways: NDArray[np.float64], solid: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which rays, from each start [P, 3] in each direction of ``ways`` [D, 3], hit solid points [N, 3], bool [P, D]."""
    hits = np.zeros((len(start), len(ways)), np.bool_)
    near = ((solid > start.min(axis=0) - FARTHEST) & (solid < start.max(axis=0) + FARTHEST)).all(axis=1)
    if not near.any():
        return hits
    low = solid[near].min(axis=0)
    blocks = np.zeros(((solid[near].max(axis=0) - low) / BLOCK).astype(int) + 3, np.bool_)  # its rim stays False
    blocks[tuple(((solid[near] - low) / BLOCK).astype(int).T + 1)] = True
    for far in np.arange(BLOCK, FARTHEST, STEP):
        cell = (np.floor((start[:, axis, None] + far * ways[:, axis] - low[axis]) / BLOCK) + 1 for axis in range(3))
        hits |= blocks[tuple(np.clip(at, 0, blocks.shape[axis] - 1).astype(int) for axis, at in enumerate(cell))]
    return hits


def _hemisphere() -> NDArray[np.float64]:
    """Return DIRECTIONS directions around +z, evenly spread (a Fibonacci lattice), float64 [DIRECTIONS, 3]."""
    number = np.arange(DIRECTIONS) + 0.5
    up, turn = number / DIRECTIONS, np.pi * (1 + 5**0.5) * number
    across = np.sqrt(1 - up * up)
    return np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=1)


class Light(NamedTuple):
    """Logarithms of encoded brightness, float32 [h, w, 3]: ``expected`` without the removed objects, and ``kept`` away
    by them (negative)."""

    expected: Colours
    kept: Colours


def fit_light(texture: Texture, level: Colours, label: NDArray[np.int32], good: Mask, blocked: Blocked) -> Light:
    """Fit the ``level`` [h, w, 3], log brightness, of the texels that are ``good``: a colour for each label, light that
    changes smoothly (a quadric), and less of it where things block it. Texels far from the fit count less."""
    kinds = np.unique(label[good])
    y, x = np.mgrid[0 : label.shape[0], 0 : label.shape[1]] * texture.texel
    x, y = x - x[good].mean(), y - y[good].mean()
    before, after = (np.log(1 - DARKEST * each).astype(np.float64) for each in blocked)
    even = np.stack([*(label == kind for kind in kinds), x, y, x * x, x * y, y * y], axis=-1).astype(np.float64)
    design = np.concatenate([even, before], axis=-1)
    rows = np.argwhere(good)
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:SAMPLES]]
    some, wanted = design[tuple(rows.T)], level[tuple(rows.T)].astype(np.float64)
    low = np.r_[np.full(design.shape[-1] - 2, -np.inf), 0.0, 0.0]
    high = np.r_[np.full(design.shape[-1] - 2, np.inf), STRONGEST, STRONGEST]
    found = np.zeros((design.shape[-1], 3))
    for channel in range(3):
        weight = np.ones(len(some))
        for _ in range(ROUNDS):
            fit = lsq_linear(some * weight[:, None], wanted[:, channel] * weight, (low, high)).x
            weight = 1 / np.sqrt(1 + ((some @ fit - wanted[:, channel]) / USUAL) ** 2)
        found[:, channel] = fit
    expected = np.concatenate([even, after], axis=-1) @ found
    return Light(expected.astype(np.float32), ((before - after) @ found[-2:]).astype(np.float32))
