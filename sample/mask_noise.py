"""Draw the regions that a network would find for the true regions of a view: missed, split, merged, invented, ragged.

A network does not choose the class anew in every frame. It mistakes a sofa for a bed from one side, while it is small,
over a stretch of neighbouring views, and then gets it right again. So the belief in each class is a smooth random
function of the direction of view, the size in the picture and the place, fixed by the seed for each object. Flicker is
added. All arithmetic is numpy's, term by term, and rounded before comparisons, so that a seed gives the same pixels
everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from shared import stream

Ids = NDArray[np.int32]
Bools = NDArray[np.bool_]

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
"""For each true class of the sample, the classes it is mistaken for, with their weights. 1 is the ordinary weight."""


@dataclass(frozen=True)
class BeliefNoise:
    """How unsure the network is of classes; each number is explained below it. Logits are in nats."""

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
    """How a region appears in one view: its ``area`` as a share of the picture, its ``place`` in world metres, and the
    unit ``direction`` from the camera to it. ``key`` is the same in all views."""

    key: str
    class_name: str
    is_thing: bool
    area: float
    place: tuple[float, float, float]
    direction: tuple[float, float, float]


def confusions(class_name: str, is_thing: dict[str, bool]) -> dict[str, float]:
    """Return the classes that a class is taken for, with weights: those of ``CONFUSIONS``, else three of its kind."""
    known = {other: weight for other, weight in CONFUSIONS.get(class_name, {}).items() if other in is_thing}
    alike = [other for other, thing in is_thing.items() if thing == is_thing[class_name] and other != class_name]
    return known or {str(other): 1.0 for other in stream("confusions", class_name).permutation(sorted(alike))[:3]}


def believe(sight: Sight, is_thing: dict[str, bool], noise: BeliefNoise, seed: int, frame: str) -> tuple[str, float]:
    """Return the class among ``is_thing`` that the network believes in, and its score in (0, 1)."""
    others = confusions(sight.class_name, is_thing)
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
    """Return the swing of the belief in class ``other`` at a ``sight``, ``doublings`` of the ordinary size away: a
    smooth random function of mean 0, deviation 1."""
    waves = 12
    draw = stream(seed, "swing", sight.key, other)
    place = np.zeros(3) if sight.is_thing else np.array(sight.place) / noise.place_scale
    at: NDArray[np.float64] = np.array(
        [*(np.array(sight.direction) / noise.direction_scale), doublings / noise.size_scale, *place]
    )
    frequencies, phases = draw.normal(size=(waves, len(at))), draw.random(waves) * 2 * np.pi
    return float(np.round(np.cos((frequencies * at).sum(1) + phases).sum() * np.sqrt(2 / waves), 6))


@dataclass(frozen=True)
class MaskNoise:
    """How often and how strongly a network errs. Lengths are pixels of the view, chances per segment, unless said."""

    belief: BeliefNoise = field(default_factory=BeliefNoise)
    smallest_segment: int = 60
    """The fewest pixels of a thing that is found. Smaller ones become part of what surrounds them."""
    missed: float = 0.07
    """Chance that a thing of ordinary size is missed. It is up to three times as high for small ones."""
    missed_as_void: float = 0.6
    """Share of the missed things that leave a hole. The neighbour with the longest border swallows the others."""
    split: float = 0.10
    """Chance that a segment breaks in two."""
    split_disagrees: float = 0.4
    """Chance that the second part gets its own class, as if it were another thing."""
    merged: float = 0.35
    """Chance that two touching things of the same class are drawn as one."""
    invented: float = 0.6
    """Mean number of segments in a frame that show nothing."""
    invented_radius: tuple[float, float] = (8.0, 24.0)
    invented_score: tuple[float, float] = (0.25, 0.65)
    cell: int = 4
    """The network draws at 1/cell of the resolution."""
    edge_warp: float = 1.6
    """Standard deviation by which edges wander."""
    edge_warp_length: int = 12
    """Length over which the wandering is correlated."""
    bleed: float = 0.12
    """Standard deviation over segments of a bonus to their share. 0.5 moves an edge by half a cell or more."""
    unsure_below: float = 0.42
    """Least share of a segment in a pixel. Pixels without such a segment become void."""
    stuff_void: float = 0.06
    """Share of stuff that is left void, in blobs."""
    stuff_void_length: int = 24


@dataclass(frozen=True)
class Region:
    """A region that the network draws: its pixels, bool [H, W], and the class that it gets."""

    pixels: Bools
    class_name: str
    is_thing: bool
    score: float


@dataclass(frozen=True)
class TrueRegion:
    """A thing or a connected piece of stuff of the ground truth in a view."""

    pixels: Bools
    sight: Sight


def detect(
    regions: list[TrueRegion], is_thing: dict[str, bool], noise: MaskNoise, seed: int, frame: str
) -> tuple[Ids, list[Region]]:
    """Return segment ids, int32 [H, W], and the regions that the network sees. 0 is void, k + 1 is the k-th region.
    ``is_thing`` contains all classes that the network knows."""
    random = stream(seed, "frame", frame)
    height, width = regions[0].pixels.shape
    kept, holes = _miss(regions, noise, random)
    seen: list[Region] = []
    for region in kept:
        seen.extend(_classified(region, is_thing, noise, seed, frame=frame, random=random))
    seen = _merge(seen, noise, random)
    ids = _draw(seen, holes, noise, random)
    stuff = np.array([False, *(not region.is_thing for region in seen)])
    blots = _smooth_noise(height, width, noise.stuff_void_length, random)
    ids[stuff[ids] & (blots > np.quantile(blots, 1 - noise.stuff_void))] = 0
    for invented in _invent(height, width, is_thing, noise, random):
        seen.append(invented)
        ids[invented.pixels] = len(seen)
    return _renumber(ids, seen, random)


def _miss(regions: list[TrueRegion], noise: MaskNoise, random: np.random.Generator) -> tuple[list[TrueRegion], Bools]:
    """Return the regions that are found, and the holes, bool [H, W], of missed regions that no neighbour covers."""
    found: list[TrueRegion] = []
    swallowed: list[Bools] = []
    holes = np.zeros_like(regions[0].pixels)
    for region in regions:
        chance, fate = random.random(2)
        area = int(region.pixels.sum())
        smallness = min(3.0, max(1.0, (20 * noise.smallest_segment / max(area, 1)) ** 0.5))
        if region.sight.is_thing and (area < noise.smallest_segment or chance < noise.missed * smallness):
            if area >= noise.smallest_segment and fate < noise.missed_as_void:
                holes |= region.pixels
            else:
                swallowed.append(region.pixels)
        else:
            found.append(region)
    for pixels in swallowed:
        rim = _grown(pixels) & ~pixels
        shares = [int((rim & region.pixels).sum()) for region in found]
        if any(shares):
            nearest = int(np.argmax(shares))
            found[nearest] = replace(found[nearest], pixels=found[nearest].pixels | pixels)
    return found, holes


def _classified(
    region: TrueRegion,
    is_thing: dict[str, bool],
    noise: MaskNoise,
    seed: int,
    *,
    frame: str,
    random: np.random.Generator,
) -> list[Region]:
    """Return how the network draws a region: as one or split into two parts, each with its class."""
    name, score = believe(region.sight, is_thing, noise.belief, seed, frame)
    halves = random.random() < noise.split
    angle, shift, disagrees = random.random() * np.pi, random.normal() * 0.5, random.random() < noise.split_disagrees
    if not halves:
        return [Region(region.pixels, name, is_thing[name], score)]
    y, x = np.nonzero(region.pixels)
    along = np.round((x - x.mean()) * np.cos(angle) + (y - y.mean()) * np.sin(angle), 6)
    side = np.zeros_like(region.pixels)
    side[y, x] = along > np.round(shift * along.std(), 6)
    other, other_score = name, round(score * 0.9, 4)
    if disagrees:
        part = replace(region.sight, key=region.sight.key + " part", area=region.sight.area / 2)
        other, other_score = believe(part, is_thing, noise.belief, seed, frame)
    return [
        Region(region.pixels & ~side, name, is_thing[name], score),
        Region(side, other, is_thing[other], other_score),
    ]


def _merge(seen: list[Region], noise: MaskNoise, random: np.random.Generator) -> list[Region]:
    """Merge all stuff of one class into one segment, and sometimes touching things of one class."""
    merged: list[Region] = []
    for region in seen:
        partner = None
        for index, earlier in enumerate(merged):
            if earlier.class_name != region.class_name:
                continue
            touches = bool((_grown(earlier.pixels) & region.pixels).any())
            if not region.is_thing or (touches and random.random() < noise.merged):
                partner = index
                break
        if partner is None:
            merged.append(region)
        else:
            earlier = merged[partner]
            bigger = max(earlier, region, key=lambda each: int(each.pixels.sum()))
            merged[partner] = replace(bigger, pixels=earlier.pixels | region.pixels)
    return merged


def _grown(pixels: Bools) -> Bools:
    """Return the region and all pixels within two of it, to the sides and diagonally."""
    return cv2.dilate(pixels.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def _draw(seen: list[Region], holes: Bools, noise: MaskNoise, random: np.random.Generator) -> Ids:
    """Draw as a low-resolution network would: ids are 1 + the index in ``seen``; 0 for ``holes`` and where unsure."""
    height, width = holes.shape
    shares = [_coarse(holes, noise.cell), *(_coarse(region.pixels, noise.cell) for region in seen)]
    bonuses = np.concatenate([[0.0], random.normal(size=len(seen)) * noise.bleed])
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    x += noise.edge_warp * _smooth_noise(height, width, noise.edge_warp_length, random)
    y += noise.edge_warp * _smooth_noise(height, width, noise.edge_warp_length, random)
    best, ids = np.full((height, width), noise.unsure_below), np.zeros((height, width), np.int32)
    for index, (share, bonus) in enumerate(zip(shares, bonuses, strict=True)):
        strength = _read(share, (x + 0.5) / noise.cell - 0.5, (y + 0.5) / noise.cell - 0.5)
        strength = np.round(np.where(strength > 0.05, strength + bonus, 0.0), 6)
        wins = strength > best
        best[wins], ids[wins] = strength[wins], index
    return ids


def _coarse(pixels: Bools, cell: int) -> NDArray[np.float64]:
    """Return how much of each coarse cell (``cell`` pixels) is covered, float64 [h, w], slightly blurred."""
    height, width = pixels.shape
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.pad(pixels, ((0, rows * cell - height), (0, columns * cell - width)), mode="edge")
    share = padded.reshape(rows, cell, columns, cell).sum((1, 3)) / float(cell * cell)
    for axis in (0, 1):
        pads = ((1, 1), (0, 0)) if axis == 0 else ((0, 0), (1, 1))
        wide = np.pad(share, pads, mode="edge")
        before, after = (wide[:-2], wide[2:]) if axis == 0 else (wide[:, :-2], wide[:, 2:])
        share = 0.125 * before + 0.75 * share + 0.125 * after
    return share


def _read(field_: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values of ``field_`` at columns x and rows y, bilinear and clamped to its edges."""
    x, y = np.clip(x, 0, field_.shape[1] - 1), np.clip(y, 0, field_.shape[0] - 1)
    left, top = np.minimum(x.astype(int), field_.shape[1] - 2), np.minimum(y.astype(int), field_.shape[0] - 2)
    fx, fy = x - left, y - top
    upper = field_[top, left] * (1 - fx) + field_[top, left + 1] * fx
    lower = field_[top + 1, left] * (1 - fx) + field_[top + 1, left + 1] * fx
    return upper * (1 - fy) + lower * fy


def _smooth_noise(height: int, width: int, length: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return a random field [H, W] that varies over ``length`` pixels, with deviation about 1, rounded to 1/64."""
    coarse = random.normal(size=(height // length + 3, width // length + 3))
    y, x = np.mgrid[0:height, 0:width] / float(length) + random.random()
    return np.round(_read(coarse, x, y) * 1.5 * 64) / 64


def _invent(
    height: int, width: int, is_thing: dict[str, bool], noise: MaskNoise, random: np.random.Generator
) -> list[Region]:
    """Return things that are not there, drawn as tilted ellipses."""
    things = [name for name, thing in is_thing.items() if thing]
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    invented = []
    for _ in range(int(random.poisson(noise.invented))):
        centre_x, centre_y, angle = random.random() * width, random.random() * height, random.random() * np.pi
        radii = random.uniform(*noise.invented_radius, size=2)
        u = (x - centre_x) * np.cos(angle) + (y - centre_y) * np.sin(angle)
        v = (y - centre_y) * np.cos(angle) - (x - centre_x) * np.sin(angle)
        pixels = np.round((u / radii[0]) ** 2 + (v / radii[1]) ** 2, 6) < 1
        score = round(float(random.uniform(*noise.invented_score)), 4)
        invented.append(Region(pixels, things[int(random.integers(len(things)))], True, score))
    return invented


def _renumber(ids: Ids, seen: list[Region], random: np.random.Generator) -> tuple[Ids, list[Region]]:
    """Drop segments without pixels and number the others in random order, as ids mean nothing across views."""
    present = [index for index in range(len(seen)) if (ids == index + 1).any()]
    order = [present[int(each)] for each in random.permutation(len(present))]
    table = np.zeros(len(seen) + 1, np.int32)
    table[np.array(order, int) + 1] = np.arange(1, len(order) + 1)
    new = table[ids]
    return new, [replace(seen[index], pixels=new == number + 1) for number, index in enumerate(order)]
