"""Find what a removal leaves for a person to see to: a hole that stays empty, and objects that hang in the air."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..corrections import CorrectedResult
from ..lift.baking import FrameBaker
from .views import PlateView

HELD = 0.1
"""Metres from an object's lowest points within which what carries it has a point: two or three times their spacing."""
LOWEST = 0.05
"""Metres above an object's lowest end within which its points count as its lowest ones."""
LOOKED_AT, TOLD = 3, 0.02
"""How many photos are looked at, those with most of the objects; and the empty share of the hole that is not told."""


def remains_of(
    before: CorrectedResult, after: CorrectedResult, ids: Collection[int], baker: FrameBaker | None,
    views: Sequence[PlateView],
) -> Iterator[str]:  # fmt: skip
    """Yield a line for each thing that the removal of objects ``ids`` leaves undone. ``baker`` shows the room without
    the objects, and ``views`` are the photos of them; None and empty: the hole is not looked at."""
    names = {one.id: one.name for one in after.instances}
    hanging = hanging_objects(before, after, ids)
    if hanging:
        listed, numbers = ", ".join(names[one] for one in hanging), " ".join(map(str, hanging))
        yield f"nothing carries {listed} any more: perhaps remove them, too ({numbers})"
    share = 0.0 if baker is None else empty_share(baker, views)
    if share > TOLD:
        yield f"{share:.0%} of the hole stays empty (alpha 0 in passes): no plane that photos saw continues there"


def hanging_objects(before: CorrectedResult, after: CorrectedResult, ids: Collection[int]) -> list[int]:
    """Return the ids of objects that stood on the removed objects ``ids`` alone, by the lift's points ``before`` the
    removal and ``after`` it."""
    removed = before.points.xyz[np.isin(before.points.instance_id, sorted(ids))]
    below = cKDTree(removed)
    xyz, instance = after.points.xyz, after.points.instance_id
    near = ((xyz > removed.min(axis=0) - HELD) & (xyz < removed.max(axis=0) + HELD)).all(axis=1)
    found = []
    for one in np.unique(instance[near & (instance > 0)]).tolist():
        own = xyz[instance == one]
        feet = own[own[:, 2] < np.percentile(own[:, 2], 2) + LOWEST]
        beside = ((xyz > feet.min(axis=0) - HELD) & (xyz < feet.max(axis=0) + HELD)).all(axis=1) & (instance != one)
        carriers = (below, cKDTree(xyz[beside]))
        stood, stands = (np.isfinite(each.query(feet, distance_upper_bound=HELD)[0]) for each in carriers)
        if (stood & ~stands).mean() > 0.5:
            found.append(one)
    return found


def empty_share(baker: FrameBaker, views: Sequence[PlateView]) -> float:
    """Return the share, 0 to 1, of removed objects' pixels in ``views`` that are now empty (alpha below 0.5)."""
    looked_at = sorted(views, key=lambda view: -int(view.leaves.sum()))[:LOOKED_AT]
    of_hole = [baker.decided(view.camera, wanted=("combined",)).combined[view.leaves, 3] < 0.5 for view in looked_at]
    return float(np.concatenate(of_hole).mean()) if any(map(len, of_hole)) else 0.0
