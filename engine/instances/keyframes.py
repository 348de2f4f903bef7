"""Keyframes of a long scan: views whose masks suffice to find the objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .agreement import MasksInSpace

SIGHTINGS = 5
"""Keyframes that should see every point, if that many views see it at all."""
WORTH_IT = 0.25
"""A view is added when more than this share of its points are seen by too few keyframes."""


def choose_keyframes(space: MasksInSpace, most_masks: int) -> NDArray[np.int64]:
    """The numbers of the views whose masks are joined into objects, ascending.

    These are all views if they have at most ``most_masks`` masks together. Otherwise views are chosen evenly, and every
    view without which surfaces would be seen too rarely is added; so there may be slightly more masks than that.
    """
    views = space.sight.shape[0]
    if len(space.masks) <= most_masks:
        return np.arange(views)
    wanted = max(1, views * most_masks // len(space.masks))
    chosen = np.zeros(views, bool)
    chosen[np.linspace(0, views - 1, wanted).round().astype(np.int64)] = True
    seen = np.asarray(space.sight.sum(0)).reshape(-1)
    sighted = np.asarray(space.sight[chosen].sum(0)).reshape(-1)
    # One sighting at a time. If all were required at once, they would all come from the first views of a surface.
    for wanted in range(1, SIGHTINGS + 1):
        lacking = np.minimum(seen, wanted) - sighted
        for view in np.flatnonzero(~chosen):
            points = space.sight[view].indices
            if len(points) and (lacking[points] > 0).mean() > WORTH_IT:
                chosen[view] = True
                lacking[points] -= 1
                sighted[points] += 1
    return np.flatnonzero(chosen)
