"""Find wrong poses: drift over time, and single frames whose pose is off, out of order or duplicated."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..job.progress import Progress, unwatched
from ..posed.layout import listed
from ..scene import Scene, digests_of_files
from .findings import MEND, Finding, side_by_side
from .reprojection import Assumption, Examined, Floats, Pairs, Views, assumed_poses, lens_under

_WIDE = 0.15  # a fraction of the depth; a surface farther off is a different one
_LEAST_POINTS = 40
_QUANTILE = 0.3  # of a pair's distances: some points of any two views lie on surfaces that only one of them sees
_LEAST_PAIRS, _LEAST_LAGS, _LEAST_EACH = 30, 6, 8
_LEAST_ACROSS = 20  # minimum pairs of looks across a gap, and within each of the parts
_NEAR = 3  # frames between two looks that count as neighbours
_HALF, _ENOUGH = 0.5, 0.2
_DRIFTED, _DRIFTED_SHARE = 0.02, 0.0075
"""Minimum drift in metres, or this fraction of the median depth if that is more. Sensors' own noise stays below."""
_GROWN = 4.0  # minimum ratio of the distances of distant frames to those of neighbours
_CERTAIN = 5.0  # standard errors
_FACING = 0.85  # minimum cosine between a world axis and the normal of a surface that faces it
_AXIS_DRIFTED, _AXIS_GROWN, _AXIS_CERTAIN = 0.01, 8.0, 12.0
"""The same limits for the surfaces that face one axis. There are fewer of them, so the limits are stricter; the
synthetic hand-held capture without faults reaches a factor of 9, but 8 standard errors."""


class Drift(NamedTuple):
    """How far apart the same surface is in two frames. ``near`` and ``far`` are medians in metres: over the pairs of
    neighbours, and over the pairs at least half as far apart in time as any pair that sees the same surface.
    ``certainty`` is the rank correlation of distance and time in standard errors."""

    near: float
    far: float
    certainty: float


class Gap(NamedTuple):
    """A jump in the recording before the frame ``number``. ``across`` and ``within`` are median distances of surfaces,
    in metres, over pairs of frames on both sides of the jump and on one side."""

    number: int
    across: float
    within: float


def pose_findings(examined: Examined, assumed: Assumption) -> tuple[list[Finding], tuple[str, ...]]:
    """Return findings about drift and single frames whose pose is off, and the world axes along which drift was not
    tested, as too few frames far apart in time share surfaces that face them. Frames must be in order."""
    distances, along = _surface_distances(examined.views, examined.pairs, assumed)
    numbers = np.array([look.number for look in examined.looks])
    lags = np.abs(numbers[examined.pairs[:, 0]] - numbers[examined.pairs[:, 1]]).astype(np.float64)
    drift = _measure_drift(distances, lags, len(examined.looks))
    depth = float(np.median(examined.views.values[examined.views.values > 0.0])) * assumed.unit
    least = max(_DRIFTED, _DRIFTED_SHARE * depth)
    found = []
    if drift is not None and drift.far > max(least, _GROWN * drift.near) and drift.certainty > _CERTAIN:
        found = [_drift_finding(drift)]
    gap = None if found else _measure_gap(distances, numbers[examined.pairs])
    if gap is not None and gap.across > max(least, _GROWN * gap.within):
        name = examined.scene.frames[gap.number].name
        text = (
            f"the poses before frame {name} do not fit those from it on: surfaces that both parts see are "
            f"{gap.across * 100:.1f} cm apart, against {gap.within * 100:.1f} cm within the parts"
        )
        option = "register the two parts to each other again, or lift only one of them with a splits.json"
        figures: dict[str, float | str] = {"across_m": gap.across, "within_m": gap.within, "frame": name}
        found.append(Finding("parts apart", text, option, figures=figures, frames=(name,)))
    shifts = zip("xyz", along.T, strict=True)
    by_axis = {axis: _measure_drift(shift, lags, len(examined.looks)) for axis, shift in shifts}
    if drift is not None and not found:
        # Drift along one axis of the world, which only the surfaces that face it show.
        grown = {
            axis: each for axis, each in by_axis.items() if each is not None
            and each.far > max(_AXIS_DRIFTED, _AXIS_GROWN * each.near) and each.certainty > _AXIS_CERTAIN
        }  # fmt: skip
        worst = sorted(grown, key=lambda axis: -grown[axis].certainty)[:1]
        found = [_drift_finding(grown[axis], f" along {axis}") for axis in worst]
    rows = _misplaced_looks(examined.views, examined.pairs, assumed)
    found = [*found, *([_misplaced_finding(examined, rows)] if rows else [])]
    return found, tuple(axis for axis, each in by_axis.items() if each is None)


def _surface_distances(views: Views, pairs: Pairs, assumed: Assumption) -> tuple[Floats, Floats]:
    """Return how far apart a pair's two frames place the surface that both see, in metres: a low quantile along
    normals, float64 [P], and the median along each axis, by surfaces that face it, [P, 3]; nan with few points."""
    lens, poses = lens_under(views.lens, assumed), views.poses_of(assumed)
    world, known = views.world_points(assumed, lens, poses)
    found, along = np.full(len(pairs), np.nan), np.full((len(pairs), 3), np.nan)
    for row, (one, other) in enumerate(pairs.tolist()):
        local = (world[one][known[one]] - poses[other, :3, 3]) @ poses[other, :3, :3]
        surface = views.surface_at(other, local, assumed, lens[other])
        near = np.isfinite(surface.distance) & (np.abs(surface.distance) < _WIDE * np.abs(local[:, 2]))
        if near.sum() >= _LEAST_POINTS:
            found[row] = np.quantile(np.abs(surface.distance[near]), _QUANTILE)
        cosine = surface.normal[near] @ poses[other, :3, :3].T
        for axis, facing in enumerate((np.abs(cosine) > _FACING).T):
            if facing.sum() >= _LEAST_POINTS:
                along[row, axis] = abs(np.median(surface.distance[near][facing] / cosine[facing, axis]))
    return found, along


def _measure_drift(distances: Floats, lags: Floats, looks: int) -> Drift | None:
    """Measure how the ``distances`` of pairs of ``looks`` frames grow with the frames between, ``lags``, float64 [P]
    each. None with too few pairs."""
    good = np.isfinite(distances)
    distance, lag = distances[good], lags[good]
    if len(lag) < _LEAST_PAIRS or len(np.unique(lag)) < _LEAST_LAGS:
        return None
    beside, apart = lag <= _NEAR, lag >= lag.max() / 2.0
    if beside.sum() < _LEAST_EACH or apart.sum() < _LEAST_EACH:
        return None
    correlation = float(np.corrcoef(_ranks(distance), _ranks(lag))[0, 1])
    error = float(np.sqrt(max(1.0 - correlation**2, 1e-6) / max(looks - 2, 1)))  # pairs share looks, so these count
    return Drift(float(np.median(distance[beside])), float(np.median(distance[apart])), correlation / error)


def _ranks(values: Floats) -> Floats:
    """Return the rank of each value; equal values share their mean rank. scipy.stats takes half a second to load."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2.0)[inverse])


def _measure_gap(distances: Floats, numbers: NDArray[np.int64]) -> Gap | None:
    """Find the frame where two parts of the recording are farthest apart, by ``distances`` [P] and frames' ``numbers``
    [P, 2] of pairs. None with too few pairs."""
    known = np.isfinite(distances)
    first, last = numbers.min(1), numbers.max(1)
    found = []
    for number in np.unique(np.quantile(numbers, np.linspace(0.1, 0.9, 33)).astype(int)).tolist():
        across = known & (first < number) & (last >= number)
        within = known & ~across
        if min(across.sum(), within.sum()) >= _LEAST_ACROSS:
            found.append(Gap(number, float(np.median(distances[across])), float(np.median(distances[within]))))
    return max(found, key=lambda gap: gap.across / max(gap.within, 1e-9), default=None)


def _drift_finding(drift: Drift, along: str = "") -> Finding:
    return Finding(
        cause="drift",
        text=f"poses drift{along}: surfaces that two frames see are {drift.near * 100:.1f} cm apart between neighbours "
        f"and {drift.far * 100:.1f} cm between frames far apart in time ({drift.certainty:.0f} standard errors)",
        option="register the frames again with loop closure, or lift parts of the recording with a splits.json",
        figures={"near_m": drift.near, "far_m": drift.far, "certainty": drift.certainty},
    )


def _misplaced_looks(views: Views, pairs: Pairs, assumed: Assumption) -> list[int]:
    """Return the rows of frames that agree with none of their neighbours, although these agree with each other."""
    comparison = views.compare(pairs, assumed)
    share = comparison.agrees.sum(1) / np.maximum(comparison.known.sum(1), 1)
    by_pair = {(min(pair), max(pair)): float(value) for pair, value in zip(pairs.tolist(), share, strict=True)}
    found = []
    for row in range(1, len(views.looks) - 1):
        near = [(a, b) for a in range(row - _NEAR, row + 1) for b in range(row, row + _NEAR + 1) if 0 < b - a <= _NEAR]
        own = max((by_pair.get(pair, 0.0) for pair in near if row in pair), default=0.0)
        across = max((by_pair.get(pair, 0.0) for pair in near if row not in pair), default=0.0)
        if across > _ENOUGH and own < _HALF * across:
            found.append(row)
    return found


def _misplaced_finding(examined: Examined, rows: list[int]) -> Finding:
    names = tuple(examined.name(row) for row in rows)
    agrees = "1 frame agrees" if len(rows) == 1 else f"{len(rows)} frames agree"
    beside = (max(rows[0] - 1, 0), rows[0])
    return Finding(
        cause="frames out of place",
        text=f"{agrees} with no neighbour, although the neighbours agree with each other: {listed(names)}",
        option=f"leave them out; {MEND} writes a scene without them",
        figures={"frames": float(len(rows))},
        is_mended=True,
        frames=names,
        picture=side_by_side([(examined.name(row), examined.photo(row).grey) for row in beside]),
    )


_FEWEST, _MOST = 12, 1500  # bounds of the number of frames whose order is measured; all pairwise distances are computed
_REACH = 2.0  # assumed metres to what a camera looks at; steps between frames are measured there, so that turns count


class FrameOrder(NamedTuple):
    """The steps between successive frames, in metres by which the point that they look at moves. ``given`` is the
    median step in the order of the names, ``shortest`` that of ``path``, which always goes to the nearest frame.
    ``rank`` is the median fraction of all frames that are nearer to a frame than its successor. ``smoothness`` is the
    median cosine between successive steps of ``path``: 1 if straight, 0 if random."""

    given: float
    shortest: float
    rank: float
    smoothness: float
    path: tuple[int, ...]

    @property
    def is_shuffled(self) -> bool:
        """Whether the frames seem a smooth recording in shuffled order, not views from random places."""
        return self.rank > 1 / 6 and self.shortest * 4.0 < self.given and self.smoothness > 0.5


def measure_order(scene: Scene, assumed: Assumption) -> FrameOrder | None:
    """Measure the order of all frames under an assumption; None with too few or too many frames."""
    count = len(scene.frames)
    if not _FEWEST <= count <= _MOST:
        return None
    turn = np.eye(3) if scene.turn is None else scene.turn
    poses = assumed_poses(np.stack([frame.camera.camera_to_world for frame in scene.frames]), turn, assumed)
    points = np.concatenate([poses[:, :3, 3] + _REACH * poses[:, :3, 2], poses[:, :3, 3]], axis=1)
    squares = (points**2).sum(1)  # |a - b|^2 = |a|^2 + |b|^2 - 2 ab needs no array [N, N, 6]
    distances = np.sqrt(np.maximum(squares[:, None] + squares[None] - 2.0 * points @ points.T, 0.0) / 2.0)
    np.fill_diagonal(distances, np.inf)  # no frame is its own neighbour
    steps = distances[np.arange(count - 1), np.arange(1, count)]
    nearer = (distances[:-1] < steps[:, None]).sum(1)
    # The second walk begins at an end of the recording: the last frame of a walk from anywhere.
    path = _walk(distances, _walk(distances, 0)[-1])
    moves = np.diff(points[path], axis=0)
    lengths = np.linalg.norm(moves, axis=1)
    moving = (lengths[1:] > 1e-9) & (lengths[:-1] > 1e-9)
    cosines = (moves[1:] * moves[:-1]).sum(1)[moving] / (lengths[1:] * lengths[:-1])[moving]
    return FrameOrder(
        given=float(np.median(steps)),
        shortest=float(np.median(distances[path[:-1], path[1:]])),
        rank=float(np.median(nearer)) / count,
        smoothness=float(np.median(cosines)) if len(cosines) else 0.0,
        path=tuple(path),
    )


def _walk(distances: Floats, start: int) -> list[int]:
    """Return the order of a walk that begins at ``start`` and goes to the nearest unvisited frame each time."""
    left = distances.copy()
    path = [start]
    for _ in range(len(distances) - 1):
        left[:, path[-1]] = np.inf
        path.append(int(left[path[-1]].argmin()))
    return path


def order_findings(scene: Scene, order: FrameOrder | None) -> list[Finding]:
    """Return a finding if the frames are not in the order of their recording."""
    if order is None or not order.is_shuffled:
        return []
    best = listed([scene.frames[number].name for number in order.path], 6)
    finding = Finding(
        cause="unsorted frames",
        text=f"frames are not in the order of the recording: what the cameras look at moves by {order.given:.2f} m "
        f"from one frame to the next, and by {order.shortest:.2f} m in the order {best}",
        option="name the files in the order of the recording",
        figures={"step_m": order.given, "shortest_step_m": order.shortest, "nearer_share": order.rank},
    )
    return [finding]


def repeat_findings(scene: Scene, progress: Progress = unwatched) -> list[Finding]:
    """Return findings about frames that occur twice. Raises OSError."""
    frames, first, repeated = scene.frames, dict[str, int](), list[tuple[int, int]]()
    sizes = [frame.colour_path.stat().st_size if frame.file_shows_colour else 0 for frame in frames]
    shared = {size for size, count in Counter(sizes).items() if count > 1 and size}
    alike = [number for number, size in enumerate(sizes) if size in shared]  # files of different sizes differ
    digests = digests_of_files([(frames[number].colour_path,) for number in alike], progress)
    for number, key in zip(alike, digests, strict=True):
        if key and first.setdefault(key, number) != number:
            repeated.append((number, first[key]))
    if not repeated:
        return []
    shown = [frames[number] for number in repeated[0][::-1]]
    count = "1 frame repeats" if len(repeated) == 1 else f"{len(repeated)} frames repeat"
    pairs = ", ".join(f"{frames[a].name} is {frames[b].name}" for a, b in repeated[:3])
    finding = Finding(
        cause="repeated frames",
        text=f"{count} the picture of another ({pairs})",
        option=f"leave them out; {MEND} writes a scene without them",
        figures={"frames": float(len(repeated))},
        is_mended=True,
        frames=tuple(frames[number].name for number, _ in repeated),
        picture=side_by_side([(frame.name, frame.read_colour(None)) for frame in shown]),
    )
    return [finding]
