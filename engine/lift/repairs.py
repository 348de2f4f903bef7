"""Trials before training: what near masks show clearly and the labelled points do not.

Each such finding (``metrics/unshown.py``) is tried as an object of its own, as a part of an object of its class that it
touches, or as another class of its place. It is kept if the masks agree better with it, each as much as it resolves:
all that resolve the place, and near ones that took no part in drawing it. No object may fit its own masks worse.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..instances.agreement import ViewPoints, ViewsOnCloud, shown_classes
from ..instances.records import ObjectMask, SceneObject
from ..metrics.unshown import JudgedView, Unshown, find_unshown
from ..scene import VOID, ClassTable, OnDemand, Progress, View, are_near, evidence, resolves, watched
from ..semantics.point_cloud import SemanticPointCloud

log = logging.getLogger("plgs.lift")

SHOWN = 0.5
"""A segment's class is shown if this share of its points has it. *Not shown* in the metrics asks for less."""
SEES = 0.5
"""Share of a place's points that a view must see, or must name by a class, to have a say."""
SAME = 0.3
"""A view's segments of a class show one thing if each has this share of the first segment's points that the largest
of them has."""
LEAD = 0.3
"""The share of the evidence by which the trial must lead what is shown."""
LEAST_VIEWS = 3
"""The least views that judge a trial, and the least near views that were held back in turn."""
MOST_FALL = 0.02
"""The most IoU that an object may lose with its masks."""
LEAST_POINTS = 3
MOST_NEAR = 20
"""The most near views that draw and judge a trial, those that resolve it best."""


@dataclass(frozen=True, eq=False)
class Labelled:
    """The ``cloud`` with its classes, the ``things`` 1.., and the ``owner`` of each point, int32 [N] (0 = none)."""

    cloud: SemanticPointCloud
    owner: NDArray[np.int32]
    things: list[SceneObject]


@dataclass(frozen=True, eq=False)
class _Said:
    """What a view says at the points that it sees, [n] each: their ``row``, ``segment``, ``class_id``, and the ``word``
    of the view on each (by density)."""

    view: View
    points: ViewPoints
    class_id: NDArray[np.int32]
    word: NDArray[np.float64]

    @classmethod
    def of(cls, view: View, points: ViewPoints) -> _Said:
        word = evidence("density", points.pixels, points.resolution)
        return cls(view, points, shown_classes(view, points), word)

    def on(self, is_in: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the points that it sees are in a place, bool [n]; ``is_in`` bool [N]."""
        return is_in[self.points.row]

    def naming(self, place: NDArray[np.bool_], class_id: int) -> NDArray[np.int32]:
        """Its segments of this class that show the ``place`` bool [N]."""
        found, count = np.unique(self.points.segment[(self.class_id == class_id) & self.on(place)], return_counts=True)
        return found[count >= SAME * count.max(initial=0)]


@dataclass(frozen=True, eq=False)
class _Trial:
    """A ``finding`` with the ``rows`` int64 [n] of its points, the ``masks`` that name it, its ``leads`` among all
    views and among near ones that were held back, the numbers of these ``views``, and how much the worst object
    ``falls``."""

    finding: Unshown
    rows: NDArray[np.int64]
    masks: tuple[ObjectMask, ...]
    leads: tuple[float, float]
    views: tuple[int, int]
    falls: float

    @property
    def is_kept(self) -> bool:
        enough = len(self.rows) >= LEAST_POINTS and min(self.views) >= LEAST_VIEWS
        return enough and min(self.leads) >= LEAD and self.falls <= MOST_FALL

    def __str__(self) -> str:
        one, (all_, held), (views, near) = self.finding, self.leads, self.views
        kept = "kept" if self.is_kept else "refused"
        return (
            f"{kept}: {one.name} in place of {one.shown_as or 'nothing'}, {len(self.rows)} points (see frame "
            f"{one.frame}): leads by {all_:.0%} in {views} views, by {held:.0%} in {near} near ones that were held "
            f"back; another object's IoU with its masks falls by {self.falls:.2f} at most"
        )


def repaired(
    given: Labelled, seeing: ViewsOnCloud, classes: ClassTable, reach: float, progress: Progress
) -> Labelled:
    """The points after the trials that are kept; the log tells all of them. ``reach``: the most metres between two
    neighbouring points of one thing. Raises what ``progress`` raises."""
    table = np.append(given.cloud.class_id, VOID).astype(np.int32)
    rows, views = seeing.point_of_pixel, seeing.views
    judged = OnDemand(len(views), lambda number: JudgedView(views[number], table[rows[number]]))
    found = find_unshown(judged, classes, SHOWN)
    said = [_Said.of(view, points) for view, points in zip(views, seeing.seen, strict=True)] if found else []
    for one in watched(found, progress):
        trial = _tried(one, given, said)
        if len(trial.rows):  # otherwise an earlier trial shows it
            log.info("trial %s", trial)
        if trial.is_kept:
            given = _with(trial, given, classes.thing_ids, reach)
    return given


def _tried(finding: Unshown, given: Labelled, said: Sequence[_Said]) -> _Trial:
    """Draw and judge a trial."""
    first = next(each for each in said if each.view.name == finding.frame)
    place = np.zeros(len(given.owner), np.bool_)
    place[first.points.row[first.points.segment == finding.segment]] = True
    near = _near(place, said)
    drawn = _drawn(finding.class_id, place, near)
    rows = np.flatnonzero(drawn & (given.cloud.class_id != finding.class_id))
    held: list[tuple[float, float]] = []
    for each in near:
        rest = _drawn(finding.class_id, place, [other for other in near if other is not each])
        held += _judged(finding.class_id, rest, given, [each])
    every = _judged(finding.class_id, drawn, given, said)
    masks = tuple(
        ObjectMask(each.view.name, segment)
        for each in near
        for segment in each.view.mask.segments
        if segment.id in each.naming(place, finding.class_id)
    )
    leads, views = (_lead(every), _lead(held)), (len(every), len(held))
    return _Trial(finding, rows, masks, leads, views, _most_fall(given, rows, said))


def _near(place: NDArray[np.bool_], said: Sequence[_Said]) -> list[_Said]:
    """The views that see a place from near, the best first."""
    resolution = np.zeros(len(said))
    for number, each in enumerate(said):
        here = each.on(place)
        if here.sum() >= max(1, SEES * place.sum()):
            resolution[number] = each.points.resolution[here].mean()
    near = are_near(resolution, resolution.max(initial=0.0)) & (resolution > 0)
    return [said[number] for number in np.argsort(-resolution, kind="stable") if near[number]][:MOST_NEAR]


def _drawn(class_id: int, place: NDArray[np.bool_], near: Sequence[_Said]) -> NDArray[np.bool_]:
    """The points that most of the evidence of the ``near`` views gives to a thing of this class at the ``place``."""
    yes, all_ = np.zeros(len(place)), np.zeros(len(place))
    for each in near:
        labelled = each.points.segment > 0
        all_[each.points.row[labelled]] += each.word[labelled]
        if np.mean(each.class_id[each.on(place)] == class_id) >= SEES:
            own = np.isin(each.points.segment, each.naming(place, class_id))
            yes[each.points.row[own]] += each.word[own]
    return (yes > 0.5 * all_) & (yes > 0)


def _judged(
    class_id: int, drawn: NDArray[np.bool_], given: Labelled, judges: Sequence[_Said]
) -> list[tuple[float, float]]:
    """For each view that resolves what is ``drawn``: the evidence for this class beyond that for what is shown, and all
    of its evidence."""
    found = []
    for each in judges:
        here = each.on(drawn) & (each.points.segment > 0)
        if here.any() and here.sum() >= SEES * drawn.sum() and resolves(float(each.points.pixels[here].sum()), 1.0):
            word, shown = each.word[here], given.cloud.class_id[each.points.row[here]]
            lead = word[each.class_id[here] == class_id].sum() - word[each.class_id[here] == shown].sum()
            found.append((float(lead), float(word.sum())))
    return found


def _lead(judged: Sequence[tuple[float, float]]) -> float:
    return sum(lead for lead, _ in judged) / max(sum(all_ for _, all_ in judged), 1e-12)


def _most_fall(given: Labelled, rows: NDArray[np.int64], said: Sequence[_Said]) -> float:
    """How much the mean IoU with its masks falls of the object that suffers most from losing the points ``rows``."""
    of_view, falls = {each.view.name: each for each in said}, [0.0]
    for number in np.setdiff1d(given.owner[rows], [0]):
        own = given.owner == number
        left = own.copy()
        left[rows] = False
        if not left.any():
            return 1.0
        masks = [mask for mask in given.things[number - 1].masks if mask.frame in of_view]
        changes = [_iou(of_view[mask.frame], mask, own) - _iou(of_view[mask.frame], mask, left) for mask in masks]
        falls.append(float(np.mean(changes)) if changes else 0.0)
    return max(falls)


def _iou(said: _Said, mask: ObjectMask, own: NDArray[np.bool_]) -> float:
    inside, shown = said.points.segment == mask.segment.id, said.on(own)
    return float(said.word[inside & shown].sum() / max(said.word[inside | shown].sum(), 1e-12))


def _with(trial: _Trial, given: Labelled, thing_ids: Collection[int], reach: float) -> Labelled:
    """The points with a trial that is kept."""
    class_id, owner, things = given.cloud.class_id.copy(), given.owner.copy(), list(given.things)
    new = trial.finding.class_id
    class_id[trial.rows], owner[trial.rows] = new, 0
    if new in thing_ids:
        number = _touched(trial.rows, class_id == new, owner, given.cloud.xyz, reach)
        taken = {mask.key for one in things for mask in one.masks}  # no view's word counts twice
        masks = tuple(mask for mask in trial.masks if mask.key not in taken)
        if number:
            things[number - 1] = replace(things[number - 1], masks=(*things[number - 1].masks, *masks))
        elif masks:  # otherwise other objects were made of them
            things.append(SceneObject(len(things) + 1, masks, new))
            number = len(things)
        owner[trial.rows] = number
    return Labelled(replace(given.cloud, class_id=class_id), owner, things)


def _touched(
    rows: NDArray[np.int64], has_class: NDArray[np.bool_], owner: NDArray[np.int32], xyz: NDArray[np.float32],
    reach: float,
) -> int:  # fmt: skip
    """The object of the class that most of the points ``rows`` have within ``reach`` metres, 0 = none."""
    other = np.flatnonzero(has_class & (owner > 0))
    if not len(other):
        return 0
    distance, nearest = cKDTree(xyz[other]).query(xyz[rows], distance_upper_bound=reach)
    touched = np.bincount(owner[other[nearest[np.isfinite(distance)]]], minlength=1)
    return int(touched.argmax()) if len(touched) > 1 else 0
