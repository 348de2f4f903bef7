"""A baked view: its layers and its mattes, from a rendering in bands of rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..model.rendering import PanopticRendering
from ..scene import Camera, ClassTable, distinct_colour
from .cryptomatte import MatteLayer, class_layer, instance_layer
from .layers import PanopticLayers, decide, tell_in_coverage
from .ranking import RANKS, rank_coverage
from .surface import Surface, surface_of


@dataclass(frozen=True, eq=False)
class Matte:
    """A Cryptomatte layer and its ranks, float32 [2 RANKS, H, W]: alternately id and coverage."""

    layer: MatteLayer
    ranks: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class BakedView:
    """Everything that is written for a view, as ``camera`` sees it."""

    camera: Camera
    layers: PanopticLayers
    mattes: tuple[Matte, ...]

    @property
    def surface(self) -> Surface:
        """The surface, which is computed on demand."""
        return surface_of(self.layers.depth, self.camera)


@dataclass(frozen=True)
class ShownInstances:
    """The instances of pictures and passes: ``names`` by id. ``class_of``: the one class that an instance is shown
    with, or None if every pixel decides on its own."""

    names: Mapping[int, str]
    class_of: Mapping[int, int] | None = None

    @property
    def colours(self) -> dict[int, tuple[int, int, int]]:
        return {instance: distinct_colour(instance) for instance in self.names}


def bake_view(
    bands: Iterable[PanopticRendering], camera: Camera, classes: ClassTable, instances: ShownInstances
) -> BakedView:
    """Decide and rank ``bands`` (all rows of ``camera``'s picture, from the top) one after another, so that the
    coverage of only one is held. It is changed (see ``tell_in_coverage``). Raises ValueError if there are no bands."""
    shape = (2 * RANKS, camera.height, camera.width)
    of_instances, of_classes = np.empty(shape, np.float32), np.empty(shape, np.float32)
    layers: list[PanopticLayers] = []
    row = 0
    for band in bands:
        layers.append(decide(band, classes, instances.class_of))
        tell_in_coverage(band, classes, instances.class_of, layers[-1])
        by_class = class_layer(band.class_ids, classes)
        rank_coverage(band.class_coverage, by_class.columns, by_class.ids, band.alpha, None, of_classes, row)
        by_instance = instance_layer(band.instance_ids, instances.names, classes, instances.class_of)
        limit = things_coverage(band, classes) if instances.class_of is None else None
        columns, ids = by_instance.columns, by_instance.ids
        rank_coverage(band.instance_coverage, columns, ids, band.alpha, limit, of_instances, row)
        row += len(band.alpha)
        del band  # frees its memory before the next is made
    if not layers:
        raise ValueError("there is no band to bake")
    mattes = Matte(by_instance, of_instances), Matte(by_class, of_classes)
    return BakedView(camera, joined(layers), mattes)


def things_coverage(rendering: PanopticRendering, classes: ClassTable) -> NDArray[np.float32]:
    """The coverage of each pixel by things, float32 [H, W].

    If every pixel decides on its own, stuff has instance probabilities too (nothing forbids them). So a pixel's
    instances together get no more than this. At the edge of a chair before a wall the chair keeps its share, and
    instances of the wall get nothing. If an object has one class, its coverage is part of its class's.
    """
    things = [column for column, one in enumerate(rendering.class_ids) if one in classes.thing_ids]
    total = np.zeros_like(rendering.alpha)
    for column in things:
        total += rendering.class_coverage[..., column]
    return total


def joined(bands: list[PanopticLayers]) -> PanopticLayers:
    """All bands of rows joined into one, from the top."""
    if len(bands) == 1:
        return bands[0]
    names = [field.name for field in fields(PanopticLayers)]
    return PanopticLayers(**{name: np.concatenate([getattr(band, name) for band in bands]) for name in names})
