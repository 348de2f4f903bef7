"""Views on disk: a long scan has more of them than memory holds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .frame import PanopticMask, Segment
from .on_demand import OnDemand, StoredArrays
from .view import View


class StoredViews(OnDemand[View]):
    """The ``views``, in their order, each read back whenever it is asked for: bit for bit as it was. They are stored
    one after another, in ``folder`` (see StoredArrays); ``stored`` is told how many are."""

    def __init__(
        self, views: Iterable[View], folder: Path | None = None, stored: Callable[[int], object] | None = None
    ) -> None:
        self._arrays = StoredArrays(folder)
        self._about: list[tuple[str, Camera, tuple[Segment, ...], int | None]] = []
        for view in views:
            for array in (view.colour, view.depth, view.mask.ids):
                self._arrays.append(array)
            border = None if view.border is None else self._arrays.append(view.border)
            self._about.append((view.name, view.camera, view.mask.segments, border))
            if stored is not None:
                stored(len(self._about))
        self._first = np.cumsum([0, *(3 + (border is not None) for *_, border in self._about)]).tolist()
        super().__init__(len(self._about), self._read)

    @property
    def cameras(self) -> list[Camera]:
        return [camera for _, camera, _, _ in self._about]

    def _read(self, number: int) -> View:
        name, camera, segments, border = self._about[number]
        colour, depth, ids = (self._arrays[self._first[number] + place] for place in range(3))
        return View(name, camera, colour, depth, PanopticMask(ids, segments), self._border(border))

    def _border(self, place: int | None) -> NDArray[np.bool_] | None:
        return None if place is None else self._arrays[place]
