"""Trials before training: what near masks show clearly and the labelled points do not.

Each such finding (``metrics/unshown.py``) is tried as an object of its own, as a part of an object of its class if near
masks hold both, or as another class of its place. It is kept if the masks agree better with it, each as much as it
resolves: all that resolve the place, and near ones that took no part in drawing it. No object may fit its own masks
worse. Segments that may show several objects (``Segment.is_group``) have a say on classes, and draw nothing.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..instances.agreement import ViewPoints, ViewsOnCloud, shown_classes
from ..instances.records import ObjectMask, SceneObject
from ..metrics.unshown import POINTS, SHOWN_TRIAL, JudgedView, Refused, Unshown, find_unshown
from ..posed.layout import plural
from ..scene import VOID, ClassTable, OnDemand, Progress, View, are_near, evidence, resolves, watched
from ..semantics.point_cloud import SemanticPointCloud

log = logging.getLogger("plgs.lift")

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
    """The ``cloud`` with its classes, the ``things`` 1.., the ``owner`` of each point, int32 [N] (0 = none), and the
    trials with points that were ``refused``."""

    cloud: SemanticPointCloud
    owner: NDArray[np.int32]
    things: list[SceneObject]
    refused: tuple[Refused, ...] = ()


@dataclass(frozen=True, eq=False)
class _Said:
    """What a view says at the ``points`` that it sees, [n] each: their ``class_id``, the ``word`` of the view on each
    (by density), and whether their segment ``is_group``, which may show several objects."""

    view: View
    points: ViewPoints
    class_id: NDArray[np.int32]
    word: NDArray[np.float64]
    is_group: NDArray[np.bool_]

    @classmethod
    def of(cls, view: View, points: ViewPoints) -> _Said:
        word = evidence("density", points.pixels, points.resolution)
        groups = [segment.id for segment in view.mask.segments if segment.is_group]
        return cls(view, points, shown_classes(view, points), word, np.isin(points.segment, groups))

    def on(self, is_in: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the points that it sees are in a place, bool [n]; ``is_in`` bool [N]."""
        return is_in[self.points.row]

    def naming(self, place: NDArray[np.bool_], class_id: int) -> NDArray[np.int32]:
        """Its segments of this class that show the ``place`` bool [N], of which it sees some points; none if it names
        too few of these so."""
        is_named = (self.class_id == class_id) & self.on(place)
        if is_named.sum() < SEES * self.on(place).sum():
            return np.zeros(0, np.int32)
        found, size = np.unique(self.points.segment[is_named & ~self.is_group], return_counts=True)
        return found[size >= SAME * size.max(initial=0)]


_Drawing = Sequence[tuple[_Said, NDArray[np.int32]]]
"""Near views, each with its segments that show a place."""


@dataclass(frozen=True, eq=False)
class _Trial:
    """A ``finding`` with the points of its ``place`` and the ``rows`` of those that it would get, int64 [n] each, the
    ``masks`` that name it and are no other object's, its ``leads`` among all views and among near ones that were held
    back, the numbers of these ``views``, and how much the worst object ``falls`` (None if no object loses or gains
    points). ``owner``: the number of the object that gets the points, one more than there are for a new one; 0 = none,
    as it is stuff; None if a new one has no masks."""

    finding: Unshown
    place: NDArray[np.int64]
    rows: NDArray[np.int64]
    masks: tuple[ObjectMask, ...]
    leads: tuple[float, float]
    views: tuple[int, int]
    owner: int | None
    falls: float | None

    @property
    def is_kept(self) -> bool:
        return not self.against

    @property
    def against(self) -> list[str]:
        """Why it is refused."""
        found = [] if len(self.rows) >= LEAST_POINTS else [f"it has {plural(len(self.rows), 'point')}"]
        kinds = ("view", "what could be drawn"), ("near view", "what the others draw")
        for lead, views, (kind, what) in zip(self.leads, self.views, kinds, strict=True):
            see = plural(views, f"{kind} sees", f"{kind}s see")
            if views < LEAST_VIEWS:
                found.append(f"only {see} enough of {what} ({LEAST_VIEWS} are asked)")
            elif lead < LEAD:
                found.append(f"where {see} {what}, it {_told(lead)} (a lead of {LEAD:.0%} is asked)")
        if self.falls is not None and self.falls > MOST_FALL:
            fall = math.ceil(1000 * self.falls) / 1000  # never told as the limit that it misses
            found.append(f"an object's IoU with its masks would fall by {fall:.3f}, more than {MOST_FALL}")
        return found if self.owner is not None else [*found, "all of its masks are another object's"]

    def __str__(self) -> str:
        one = self.finding
        kept = "kept" if self.is_kept else "refused"
        told = f"{kept}: {one.name} in place of {one.shown_as or 'nothing'} (see frame {one.frame}), "
        if not len(self.rows):
            return told + "no points: near views draw none there, or an earlier trial shows them"
        all_, held = map(_told, self.leads)
        told += f"{len(self.rows)} points: {all_} among all views ({self.views[0]}), {held} among near views, each "
        told += f"asked about what the others draw ({self.views[1]})"
        if self.falls is not None:
            told += f"; an object's IoU with its masks falls by {self.falls:.3f} at most"
        return told + ("; all of its masks are another object's" if self.owner is None else "")


def repaired(given: Labelled, seeing: ViewsOnCloud, classes: ClassTable, reach: float, progress: Progress) -> Labelled:
    """The points after the trials that are kept; the log tells all of them. ``reach``: the most metres between two
    neighbouring points of one thing. Raises what ``progress`` raises."""
    table = np.append(given.cloud.class_id, VOID).astype(np.int32)
    rows, views, read = seeing.point_of_pixel, seeing.views, count()

    def judged(number: int) -> JudgedView:
        progress(next(read), 4 * len(views))  # each is read twice; the trials are the second half
        return JudgedView(views[number], table[rows[number]])

    found = find_unshown(OnDemand(len(views), judged), classes, SHOWN_TRIAL)
    said = [_Said.of(view, points) for view, points in zip(views, seeing.seen, strict=True)] if found else []
    for one in watched(found, lambda done, total: progress(total + done, 2 * total)):
        trial = _tried(one, given, said, one.class_id in classes.thing_ids, reach)
        log.info("trial %s", trial)
        if trial.is_kept:
            given = _with(trial, given)
        elif len(trial.rows):
            finding = replace(one, refused=", ".join(trial.against))
            some = trial.place[:: -(-len(trial.place) // POINTS)]
            places = tuple((float(x), float(y), float(z)) for x, y, z in given.cloud.xyz[some])
            given = replace(given, refused=(*given.refused, Refused(finding, places)))
    return given


def _tried(finding: Unshown, given: Labelled, said: Sequence[_Said], is_thing: bool, reach: float) -> _Trial:
    """Draw and judge a trial."""
    new = finding.class_id
    first = next(each for each in said if each.view.name == finding.frame)
    place = np.zeros(len(given.owner), np.bool_)
    place[first.points.row[(first.points.segment == finding.segment) & ~first.is_group]] = True
    drawing = [(each, each.naming(place, new)) for each in _near(place, said)]
    drawn = _drawn(new, len(place), drawing)
    rows = np.flatnonzero(drawn & ((given.cloud.class_id != new) | (is_thing & (given.owner == 0))))
    held: list[tuple[float, float]] = []
    for each, _ in drawing:
        rest = _drawn(new, len(place), [other for other in drawing if other[0] is not each])
        held += _judged(new, rest, given, [each])
    every = _judged(new, drawn, given, said)
    taken = {mask.key for one in given.things for mask in one.masks}  # no view's word counts twice
    named = (ObjectMask(s.view.name, one) for s, ids in drawing for one in s.view.mask.segments if one.id in ids)
    masks = tuple(mask for mask in named if mask.key not in taken)
    owner: int | None = 0
    if is_thing:
        owner = _joined(new, rows, drawing, given, reach) or (len(given.things) + 1 if masks else None)
    leads, views = (_lead(every), _lead(held)), (len(every), len(held))
    falls = _most_fall(given, rows, owner or 0, said)
    return _Trial(finding, np.flatnonzero(place), rows, masks, leads, views, owner, falls)


def _near(place: NDArray[np.bool_], said: Sequence[_Said]) -> list[_Said]:
    """The views that see a place from near, the best first."""
    resolution = np.zeros(len(said))
    for number, each in enumerate(said):
        here = each.on(place)
        if here.sum() >= max(1, SEES * place.sum()):
            resolution[number] = each.points.resolution[here].mean()
    near = are_near(resolution, resolution.max(initial=0.0)) & (resolution > 0)
    return [said[number] for number in np.argsort(-resolution, kind="stable") if near[number]][:MOST_NEAR]


def _drawn(class_id: int, points: int, drawing: _Drawing) -> NDArray[np.bool_]:
    """Which of so many points most of the evidence of these views gives to a thing of this class, bool [N]."""
    yes, all_ = np.zeros(points), np.zeros(points)
    for each, segments in drawing:
        labelled = (each.points.segment > 0) & ~(each.is_group & (each.class_id == class_id))
        all_[each.points.row[labelled]] += each.word[labelled]
        own = np.isin(each.points.segment, segments)
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


def _told(lead: float) -> str:
    """Rounded down, as no lead that is too small may read as one that is enough."""
    return f"{'leads' if lead >= 0 else 'trails'} by {abs(math.floor(1000 * lead)) / 10:.1f}%"


def _lead(judged: Sequence[tuple[float, float]]) -> float:
    return sum(lead for lead, _ in judged) / max(sum(all_ for _, all_ in judged), 1e-12)


def _most_fall(given: Labelled, rows: NDArray[np.int64], new_owner: int, said: Sequence[_Said]) -> float | None:
    """How much the mean IoU with its masks falls of the object that suffers most if the points ``rows`` get a new
    owner; None if no object loses or gains points."""
    of_view, after = {each.view.name: each for each in said}, given.owner.copy()
    after[rows] = new_owner
    falls: list[float] = []
    for number in np.setdiff1d([*given.owner[rows], new_owner], [0, len(given.things) + 1]):
        own, left = given.owner == number, after == number
        if not left.any():
            return 1.0
        masks = [mask for mask in given.things[number - 1].masks if mask.frame in of_view]
        changes = [_iou(of_view[mask.frame], mask, own) - _iou(of_view[mask.frame], mask, left) for mask in masks]
        falls.append(max(0.0, float(np.mean(changes))) if changes else 0.0)
    return max(falls, default=None)


def _iou(said: _Said, mask: ObjectMask, own: NDArray[np.bool_]) -> float:
    inside, shown = said.points.segment == mask.segment.id, said.on(own)
    return float(said.word[inside & shown].sum() / max(said.word[inside | shown].sum(), 1e-12))


def _with(trial: _Trial, given: Labelled) -> Labelled:
    """The points with a trial that is kept."""
    class_id, owner, things, number = given.cloud.class_id.copy(), given.owner.copy(), list(given.things), trial.owner
    assert number is not None, "a trial without an owner is refused"
    class_id[trial.rows], owner[trial.rows] = trial.finding.class_id, number
    if number > len(things):
        things.append(SceneObject(number, trial.masks, trial.finding.class_id))
    elif number:
        things[number - 1] = replace(things[number - 1], masks=(*things[number - 1].masks, *trial.masks))
    return replace(given, cloud=replace(given.cloud, class_id=class_id), owner=owner, things=things)


def _joined(class_id: int, rows: NDArray[np.int64], drawing: _Drawing, given: Labelled, reach: float) -> int:
    """The object of the class that most of the points ``rows`` have within ``reach`` metres, of those of which most
    views hold most of what they see in the segments that draw the trial; 0 = none."""
    other = np.flatnonzero((given.cloud.class_id == class_id) & (given.owner > 0))
    if not len(other) or not len(rows):
        return 0
    distance, nearest = cKDTree(given.cloud.xyz[other]).query(given.cloud.xyz[rows], distance_upper_bound=reach)
    touched = np.bincount(given.owner[other[nearest[np.isfinite(distance)]]])
    for number in np.argsort(-touched, kind="stable")[: np.count_nonzero(touched)]:
        own = given.owner == number
        holds = [
            np.isin(each.points.segment[each.on(own)], segments).mean() >= SEES
            for each, segments in drawing
            if len(segments) and each.on(own).any()
        ]
        if sum(holds) > 0.5 * len(holds):
            return int(number)
    return 0
