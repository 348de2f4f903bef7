"""Finds things that masks show clearly from nearby, but that the lift shows nowhere. Needs no ground truth. Candidates
are segments with enough pixels; only views that are near them can confirm them (``scene/evidence.py``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import VOID, ClassTable, View, are_near, resolution_on, resolves

LEAST_SEEN = 8
"""Least pixels of a segment at the size of the judged views. Smaller ones are edges."""
LEAST_VIEWS_OF_OBJECT, LEAST_VIEWS_OF_CLASS = 3, 2
"""Near views that must show an object of a class shown elsewhere, and those for a class that is shown nowhere."""
NAMES = 0.5
"""A view's mask confirms a segment if it gives at least this share of the segment's points the segment's class."""
AGREED = 2 / 3
"""Share of the near views that must confirm a segment. Networks confuse some classes in half of their masks."""
SHOWN = 0.1
"""Share of a segment's points below which the lift does not show the segment's class."""
POINTS = 64
"""Points that represent a segment."""
MOST_CANDIDATES = 500
"""The most segments that are looked up in all views; those with the highest resolution are taken."""
BEHIND = 0.05
"""A point is hidden if it lies behind the measured depth by more than this share of the depth, and at least 5 cm."""
MARGIN = 0.1
"""Metres around an object within which another segment of its class shows the same object."""


class JudgedView(NamedTuple):
    """A view, and the classes ``shown`` by the lift in it, int32 [H, W], 0 = none."""

    view: View
    shown: NDArray[np.int32]


@dataclass(frozen=True)
class Unshown:
    """A whole class (``whole_class``), or an object of it, that masks show and the lift does not. ``near``: how many
    nearby views see the place; ``views``: how many of these show its class there. ``frame`` shows it best, as
    ``segment`` of ``pixels`` pixels at the frame's own size, with ``resolution`` pixels per centimetre. ``shown_as``:
    the class that the lift shows there most, "" = none. ``centre``: world metres."""

    class_id: int
    name: str
    whole_class: bool
    views: int
    near: int
    frame: str
    segment: int
    pixels: int
    resolution: float
    shown_as: str
    centre: tuple[float, float, float]


class _Candidate(NamedTuple):
    """A segment with enough pixels, which the lift hardly shows with the segment's class. ``xyz`` float64 [n, 3]: up to
    POINTS of its points, world metres."""

    resolution: float
    class_id: int
    frame: str
    segment: int
    pixels: int
    shown_as: int
    xyz: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        return np.asarray(np.median(self.xyz, axis=0))

    def holds(self, other: _Candidate) -> bool:
        """Whether ``other`` is the same thing: of the same class, with its centre in the box around this candidate."""
        if self.class_id != other.class_id:
            return False
        low, high = self.xyz.min(axis=0) - MARGIN, self.xyz.max(axis=0) + MARGIN
        return bool(((low <= other.centre) & (other.centre <= high)).all())


def find_unshown(views: Sequence[JudgedView], classes: ClassTable) -> list[Unshown]:
    """Return classes, then objects, that the lift lacks, those of high resolution first. Reads each view twice."""
    found: list[_Candidate] = []
    shown: set[int] = set()
    for judged in views:
        candidates, kept = _segments(judged)
        found += candidates
        shown |= kept
    found = sorted(found, key=lambda each: (-each.resolution, each.frame, each.segment))[:MOST_CANDIDATES]
    answers = _Answers(found)
    for judged in views:
        answers.add(judged)
    return sorted(_missed(found, answers, shown, classes), key=lambda one: (not one.whole_class, -one.resolution))


def _missed(found: list[_Candidate], answers: _Answers, shown: set[int], classes: ClassTable) -> list[Unshown]:
    unshown: list[Unshown] = []
    reported: list[_Candidate] = []
    for number, one in enumerate(found):
        if any(other.holds(one) for other in reported):
            continue
        whole = one.class_id not in shown
        named, near, kept = answers.of(number)
        least = LEAST_VIEWS_OF_CLASS if whole else LEAST_VIEWS_OF_OBJECT
        is_missed = named >= max(least, AGREED * near) and kept < SHOWN
        if not is_missed or (whole and any(other.class_id == one.class_id for other in unshown)):
            continue  # a class is reported once, by its best view
        reported.append(one)
        x, y, z = (round(float(value), 3) for value in one.centre)
        unshown.append(
            Unshown(
                class_id=one.class_id, name=classes[one.class_id].name, whole_class=whole, views=named, near=near,
                frame=one.frame, segment=one.segment, pixels=one.pixels, resolution=round(one.resolution, 2),
                shown_as="" if one.shown_as == VOID else classes[one.shown_as].name, centre=(x, y, z),
            )  # fmt: skip
        )
    return unshown


def _segments(judged: JudgedView) -> tuple[list[_Candidate], set[int]]:
    """Return the view's resolved segments whose class the lift hardly shows, and the other resolved ones' classes."""
    view, shown = judged
    seen, xyz_of_pixels = view.depth > 0, view.camera.unproject(view.depth)
    candidates, kept = [], set()
    for segment in view.mask.segments:
        where = (view.mask.ids == segment.id) & seen
        count = int(np.count_nonzero(where))
        if segment.class_id == VOID or count < LEAST_SEEN or not resolves(count, view.mask_scale):
            continue
        here = shown[where]
        if np.mean(here == segment.class_id) >= SHOWN:
            kept.add(segment.class_id)
            continue
        rows, columns = np.nonzero(where)
        chosen = np.linspace(0, count - 1, min(count, POINTS)).astype(np.int64)
        rows, columns = rows[chosen], columns[chosen]
        resolution = float(resolution_on(view.camera, np.median(view.depth[where]), view.mask_scale))
        pixels = round(count * view.mask_scale**2)
        xyz = xyz_of_pixels[rows, columns]
        most = int(np.bincount(here).argmax())
        candidates.append(_Candidate(resolution, segment.class_id, view.name, segment.id, pixels, most, xyz))
    return candidates, kept


class _Answers:
    """What each view shows at each candidate's points, to confirm the candidates or not."""

    def __init__(self, found: Sequence[_Candidate]) -> None:
        self.found = found
        self._xyz = np.concatenate([one.xyz for one in found]) if found else np.zeros((0, 3))
        self._owner = np.repeat(np.arange(len(found)), [len(one.xyz) for one in found])
        self._class = np.array([one.class_id for one in found], np.int32)[self._owner]
        self._sizes = np.bincount(self._owner, minlength=len(found))
        self._rows: list[tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]] = []

    def add(self, judged: JudgedView) -> None:
        """Look up the candidates in a view. Keeps for each the resolution in which the view shows it (0 if less than
        half of its points), and the shares of seen points with its class in the mask, and in the lift."""
        if not self.found:
            return
        view, shown = judged
        index, row, column, z = view.places_in(self._xyz)
        depth = view.depth[row, column]
        seen = (depth > 0) & (np.abs(depth - z) <= np.maximum(BEHIND, BEHIND * z))
        count, of = len(self.found), self._owner[index]
        number = np.bincount(of[seen], minlength=count)
        safe = np.maximum(number, 1)
        mean_z = np.bincount(of[seen], z[seen], count) / safe
        resolution = resolution_on(view.camera, np.where(2 * number >= self._sizes, mean_z, 0.0), view.mask_scale)
        named = seen & (view.mask.class_map()[row, column] == self._class[index])
        kept = seen & (shown[row, column] == self._class[index])
        self._rows.append(
            (resolution, np.bincount(of[named], minlength=count) / safe, np.bincount(of[kept], minlength=count) / safe)
        )

    def of(self, number: int) -> tuple[int, int, float]:
        """Return, for candidate ``number``: how many near views confirm its class, how many near views see it, and the
        largest share of its points that the lift shows with this class in a view that confirms it."""
        answers = np.array([[part[number] for part in row] for row in self._rows])
        resolution, named, kept = answers.T
        near = are_near(resolution, self.found[number].resolution)
        naming = near & (named >= NAMES)
        return int(naming.sum()), int(near.sum()), float(kept[naming].max(initial=0.0))
