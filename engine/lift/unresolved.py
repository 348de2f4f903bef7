"""What share of a picture the capture does not resolve: no photo was taken from near enough, or there is no surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..job import EventWriter
from ..model.detail import finest_pixels
from ..passes.layers import PanopticLayers
from ..scene import Camera

COARSER = 2.0
"""A photo resolves a place whose pixels there are at most this many times as large as the picture's."""
LEAST_ALPHA = 0.5
"""A pixel that is covered less shows no surface."""
SAMPLES = 5000
"""About this many pixels of a picture are looked at, evenly spread."""
TOLD = 0.1
"""Share of the pixels from which on it is a warning."""


@dataclass(frozen=True)
class Unresolved:
    """Shares of a picture's pixels: ``coarse`` show what no photo resolves, ``empty`` show no surface."""

    coarse: float
    empty: float

    @property
    def share(self) -> float:
        return self.coarse + self.empty


def unresolved(layers: PanopticLayers, camera: Camera, photos: Sequence[Camera], reduced: float = 1.0) -> Unresolved:
    """How much of a ``camera``'s picture the ``photos`` do not resolve. They see through walls here. The picture that
    is meant may be this many times larger than the ``reduced`` one of the ``layers``."""
    step = -int(-((camera.width * camera.height / SAMPLES) ** 0.5) // 1)
    first = (step - 1) // 2
    depth, alpha = (each[first::step, first::step] for each in (layers.depth, layers.combined[..., 3]))
    v, u = np.indices(depth.shape) * step + first + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(depth.shape)], axis=-1)
    shown = (depth > 0) & (alpha >= LEAST_ALPHA)
    places = (local * depth[..., None])[shown] @ camera.camera_to_world[:3, :3].T + camera.centre
    finest, own = finest_pixels(places, photos), depth[shown] / (reduced * np.sqrt(camera.fx * camera.fy))
    coarse = (finest == 0) | (finest > COARSER * own)
    return Unresolved(np.count_nonzero(coarse) / depth.size, 1 - float(shown.mean()))


def tell_unresolved(found: Sequence[tuple[str, Unresolved]], events: EventWriter, *, before: bool) -> None:
    """Report the shares of views with their names: a warning if it is much of a view, and figures after the bake."""
    if not found:
        return
    mean = {name: float(np.mean([getattr(each, name) for _, each in found])) for name in ("coarse", "empty")}
    worst, most = max(found, key=lambda each: each[1].share)
    if not before:
        events.metric("unresolved", {"views": len(found), **mean, "worst": worst, "most": most.share})
    if most.share >= TOLD:
        coarse, empty, views = mean["coarse"], mean["empty"], "the views to bake" if before else "the baked views"
        events.warning(
            f"the capture does not resolve {coarse + empty:.0%} of {views} ({most.share:.0%} of {worst}): {coarse:.0%} "
            f"is shown more than {COARSER:.0f} times as large as in any photo, {empty:.0%} has no surface"
        )
