"""What class a detector believes a region to be: right mostly, and wrong in the way detectors are wrong.

A detector does not toss a coin for every frame. It mistakes a sofa for a bed from *this* side, while it is small, over
a stretch of neighbouring views, and then sees it right again. So the belief in each class is a smooth random function
of the direction of view, the size in the picture and the place, fixed for each object by the seed, plus some flicker.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CONFUSIONS: dict[str, dict[str, float]] = {
    "wall": {"door": 0.5, "window": 0.4, "cabinet": 0.4, "ceiling": 0.2},
    "floor": {"rug": 0.8, "wall": 0.1},
    "ceiling": {"wall": 1.0},
    "window": {"wall": 0.8, "door": 0.8, "picture": 0.3},
    "door": {"window": 1.0, "wall": 0.6, "cabinet": 0.6},
    "rug": {"floor": 1.5, "bed": 0.2},
    "chair": {"sofa": 0.8, "object": 0.5, "table": 0.3},
    "sofa": {"bed": 1.2, "chair": 0.8},
    "table": {"cabinet": 1.0, "shelf": 0.4, "bed": 0.2},
    "cabinet": {"table": 0.9, "shelf": 0.7, "appliance": 0.4},
    "shelf": {"cabinet": 0.8, "table": 0.4, "object": 0.4},
    "bed": {"sofa": 1.0, "table": 0.3},
    "television": {"picture": 1.1, "window": 0.5},
    "lamp": {"object": 1.2, "shelf": 0.2},
    "picture": {"television": 1.0, "window": 0.6, "object": 0.3},
    "bin": {"object": 1.0, "chair": 0.4, "lamp": 0.3},
    "appliance": {"cabinet": 1.2, "door": 0.8},
    "object": {"lamp": 0.6, "bin": 0.5, "picture": 0.3, "chair": 0.3},
}
"""For each true class the classes it is taken for; 1 is an ordinary rival, more a tempting one."""


@dataclass(frozen=True)
class BeliefNoise:
    """How unsure the detector is of classes. Logits are in nats."""

    thing_margin: float = 2.4
    """By how much the true class of a thing of ordinary size is ahead of an ordinary rival."""
    stuff_margin: float = 2.1
    """The same for stuff."""
    size_gain: float = 0.2
    """Added to the margin for each doubling of the area over ``ordinary_area`` (and taken away for each halving)."""
    ordinary_area: float = 0.02
    """Share of the picture."""
    size_gain_limit: float = 0.5
    """No size adds or takes more than this."""
    hardness: float = 0.4
    """Standard deviation over objects: some are hard from everywhere."""
    swing: float = 1.6
    """Standard deviation over views of the belief in each rival: the part that depends on direction, size and place."""
    flicker: float = 0.6
    """Standard deviation of what is new in each frame."""
    direction_scale: float = 0.5
    """How far the direction of view (a unit vector) must change for the swing to be another one."""
    size_scale: float = 1.2
    """The same for size, in doublings of the area."""
    place_scale: float = 2.0
    """The same for the place of a piece of stuff, in metres. A thing is one object wherever it is seen."""
    score_noise: float = 0.08
    """Standard deviation of the error of the score."""


@dataclass(frozen=True)
class Sight:
    """One region as one view shows it: its ``key`` is the same in all views, ``place`` is in world metres."""

    key: str
    class_name: str
    is_thing: bool
    area: float
    place: tuple[float, float, float]
    direction: tuple[float, float, float]


def stream(*parts: object) -> np.random.Generator:
    """A random stream of its own for everything that ``parts`` name, so that no draw depends on another's order."""
    return np.random.default_rng(zlib.crc32("/".join(map(str, parts)).encode()))


def believe(sight: Sight, noise: BeliefNoise, seed: int, frame: str) -> tuple[str, float]:
    """The class the detector believes in, and its score in (0, 1)."""
    rivals = CONFUSIONS[sight.class_name]
    doublings = float(np.log2(max(sight.area, 1e-6) / noise.ordinary_area))
    gain = float(np.clip(noise.size_gain * doublings, -noise.size_gain_limit, noise.size_gain_limit))
    margin = noise.thing_margin if sight.is_thing else noise.stuff_margin
    names = [sight.class_name, *rivals]
    logits = [margin + gain + noise.hardness * float(stream(seed, "hardness", sight.key).normal())]
    for rival, temptation in rivals.items():
        logits.append(float(np.log(temptation)) + noise.swing * _swing(sight, rival, doublings, noise, seed))
    fresh = stream(seed, "flicker", sight.key, frame)
    total = np.round(np.array(logits) + noise.flicker * fresh.normal(size=len(logits)), 6)
    winner = int(total.argmax())
    odds = np.exp(total - total[winner])
    score = float(np.clip(1 / odds.sum() + noise.score_noise * fresh.normal(), 0.05, 0.995))
    return names[winner], round(score, 4)


def _swing(sight: Sight, rival: str, doublings: float, noise: BeliefNoise, seed: int) -> float:
    """A smooth random function of the view, mean 0, deviation 1 (random Fourier features of a Gaussian kernel)."""
    waves = 12
    draw = stream(seed, "swing", sight.key, rival)
    place = np.zeros(3) if sight.is_thing else np.array(sight.place) / noise.place_scale
    at: NDArray[np.float64] = np.array(
        [*(np.array(sight.direction) / noise.direction_scale), doublings / noise.size_scale, *place]
    )
    frequencies, phases = draw.normal(size=(waves, len(at))), draw.random(waves) * 2 * np.pi
    return float(np.round(np.cos((frequencies * at).sum(1) + phases).sum() * np.sqrt(2 / waves), 6))
