"""The class that a network believes a region to be. It is mostly right, and wrong as networks are wrong.

A network does not toss a coin for every frame. It mistakes a sofa for a bed from one side, while it is small, over a
stretch of neighbouring views, and then gets it right again. So the belief in each class is a smooth random function of
the direction of view, the size in the picture and the place. The seed fixes it for each object. Flicker is added.
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
"""For each true class, the classes it is mistaken for, with their weights. 1 is the ordinary weight."""


@dataclass(frozen=True)
class BeliefNoise:
    """How unsure the network is of classes. Logits are in nats."""

    thing_margin: float = 2.4
    """Lead of the true class over an ordinary wrong one, for a thing of ordinary size."""
    stuff_margin: float = 2.1
    """The same for stuff."""
    size_gain: float = 0.2
    """Added to the margin for each doubling of the area over ``ordinary_area``, taken away for each halving."""
    ordinary_area: float = 0.02
    """Share of the picture."""
    size_gain_limit: float = 0.5
    """The most that size adds or takes away."""
    hardness: float = 0.4
    """Standard deviation over objects. Some are hard from everywhere."""
    swing: float = 1.6
    """Standard deviation over views of the belief in each wrong class, as direction, size and place change."""
    flicker: float = 0.6
    """Standard deviation of the part that is drawn independently for each frame."""
    direction_scale: float = 0.5
    """Change of the direction of view (a unit vector) after which the swing is a different one."""
    size_scale: float = 1.2
    """The same for size, in doublings of the area."""
    place_scale: float = 2.0
    """The same for the place of a piece of stuff, in metres. The place of a thing does not matter."""
    score_noise: float = 0.08
    """Standard deviation of the score's error."""


@dataclass(frozen=True)
class Sight:
    """One region in one view. Its ``key`` is the same in all views, ``place`` is in world metres."""

    key: str
    class_name: str
    is_thing: bool
    area: float
    place: tuple[float, float, float]
    direction: tuple[float, float, float]


def stream(*parts: object) -> np.random.Generator:
    """A random stream for the name ``parts``. No draw depends on the order of others."""
    return np.random.default_rng(zlib.crc32("/".join(map(str, parts)).encode()))


def believe(sight: Sight, noise: BeliefNoise, seed: int, frame: str) -> tuple[str, float]:
    """The class that the network believes in, and its score in (0, 1)."""
    others = CONFUSIONS[sight.class_name]
    doublings = float(np.log2(max(sight.area, 1e-6) / noise.ordinary_area))
    gain = float(np.clip(noise.size_gain * doublings, -noise.size_gain_limit, noise.size_gain_limit))
    margin = noise.thing_margin if sight.is_thing else noise.stuff_margin
    names = [sight.class_name, *others]
    logits = [margin + gain + noise.hardness * float(stream(seed, "hardness", sight.key).normal())]
    for other, weight in others.items():
        logits.append(float(np.log(weight)) + noise.swing * _swing(sight, other, doublings, noise, seed))
    fresh = stream(seed, "flicker", sight.key, frame)
    total = np.round(np.array(logits) + noise.flicker * fresh.normal(size=len(logits)), 6)
    winner = int(total.argmax())
    odds = np.exp(total - total[winner])
    score = float(np.clip(1 / odds.sum() + noise.score_noise * fresh.normal(), 0.05, 0.995))
    return names[winner], round(score, 4)


def _swing(sight: Sight, other: str, doublings: float, noise: BeliefNoise, seed: int) -> float:
    """A smooth random function of the view, mean 0, deviation 1 (random Fourier features of a Gaussian kernel)."""
    waves = 12
    draw = stream(seed, "swing", sight.key, other)
    place = np.zeros(3) if sight.is_thing else np.array(sight.place) / noise.place_scale
    at: NDArray[np.float64] = np.array(
        [*(np.array(sight.direction) / noise.direction_scale), doublings / noise.size_scale, *place]
    )
    frequencies, phases = draw.normal(size=(waves, len(at))), draw.random(waves) * 2 * np.pi
    return float(np.round(np.cos((frequencies * at).sum(1) + phases).sum() * np.sqrt(2 / waves), 6))
