"""Make a baked view: layers and mattes, from a rendering in bands of rows, and the surface's position and normal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, compiled, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from ..model.neural_gaussians import PanopticRendering
from ..scene import Camera, ClassTable, distinct_colour
from .cryptomatte import RANKS, MatteLayer, class_layer, instance_layer, rank_coverage
from .layers import PanopticLayers, align_mattes, decide

REACH = 0.01
"""The window of a normal's fit reaches this share of the picture's width to each side."""
SAME_SURFACE = 0.06
"""Pixels whose inverse depths differ by more than this ratio belong to different surfaces."""
PARALLEL_REACH = 0.12
"""Metres: the same for depths where rays are parallel, SAME_SURFACE of a usual 2 m."""
LEAST_SPREAD = 1e-3
"""Share of the window's own spread below which points lie on a line and define no plane."""


class Surface(NamedTuple):
    """The rendered surface: ``position`` float32 [3, H, W], world metres; ``normal`` float32 [3, H, W], world, of
    length 1, towards the camera. Both are 0 where nothing was rendered."""

    position: NDArray[np.float32]
    normal: NDArray[np.float32]


def surface_of(depth: NDArray[np.float32], camera: Camera) -> Surface:
    """Return position and normal of every pixel of a perspective or orthographic picture from its depth float32 [H, W],
    planar metres, 0 = none.

    A plane's inverse depth is linear in the pixel coordinates, and its depth if rays are parallel. So a plane is fitted
    by least squares to those of the 25 pixels around a pixel that are on the same surface, and its normal is the
    pixel's. These normals' median error is 3 to 8 degrees; that of the Gaussians' shortest axes is 20 to 30 degrees."""
    is_parallel = camera.projection == "orthographic"
    inverse = depth if is_parallel else np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    step = max(1, round(REACH * camera.width / 2))
    surface = Surface(np.empty((3, *depth.shape), np.float32), np.empty((3, *depth.shape), np.float32))
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose = np.ascontiguousarray(camera.camera_to_world, np.float64)  # the layout that the kernel is compiled for
    parallel_for(worker_count(), fit_rows, inverse, step, lens, pose, is_parallel, surface.position, surface.normal)
    return surface


@parallel_kernel
def fit_rows(
    worker: int, workers: int, inverse: Array, step: int, lens: Array, pose: Array, is_parallel: bool, position: Array,
    normal: Array,
) -> None:  # fmt: skip
    """Fit a plane at each pixel of every ``workers``-th row, and fill ``position`` and ``normal``. ``inverse`` is the
    inverse depth, or the depth if rays are parallel. A plane is fitted to pixels ``step`` apart. ``lens`` float64 [4]:
    fx, fy, cx, cy; ``pose`` float64 [4, 4], camera to world."""
    height, width = inverse.shape
    for row in range(worker, height, workers):
        for column in range(width):
            q = inverse[row, column]
            if q <= 0:
                position[:, row, column] = 0.0
                normal[:, row, column] = 0.0
                continue
            x, y = (column + 0.5 - lens[2]) / lens[0], (row + 0.5 - lens[3]) / lens[1]
            reach = PARALLEL_REACH if is_parallel else SAME_SURFACE * q
            right, down, mean = inverse_slopes(inverse, row, column, step, reach)
            # q = (n . (x, y, 1)) / d for the plane n . p = d, so its slopes give n / d
            nx, ny = right * lens[0], down * lens[1]
            nz = mean - nx * x - ny * y
            if is_parallel:  # q - nx * x - ny * y = d
                nx, ny, nz = -nx, -ny, 1.0
            to_camera = -1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            for axis in range(3):
                turned = pose[axis, 0] * nx + pose[axis, 1] * ny + pose[axis, 2] * nz
                normal[axis, row, column] = turned * to_camera
                beside = pose[axis, 0] * x + pose[axis, 1] * y
                if is_parallel:
                    position[axis, row, column] = beside + pose[axis, 2] * q + pose[axis, 3]
                else:
                    position[axis, row, column] = (beside + pose[axis, 2]) / q + pose[axis, 3]


@compiled
def inverse_slopes(inverse: Array, row: int, column: int, step: int, reach: float) -> tuple[float, float, float]:
    """Fit a plane to the inverse depth of 5 x 5 pixels ``step`` apart. Returns the plane's change to the next pixel on
    the right, its change to the next one below, and its value at the middle pixel. Only pixels within ``reach`` of the
    middle one's value count; if they are too few, both changes are 0."""
    height, width = inverse.shape
    q = inverse[row, column]
    count = su = sv = sq = suu = suv = svv = suq = svq = 0.0
    for v in range(-2, 3):
        y = row + v * step
        if y < 0 or y >= height:
            continue
        for u in range(-2, 3):
            x = column + u * step
            if x < 0 or x >= width:
                continue
            other = inverse[y, x] - q
            if abs(other) > reach:
                continue
            count += 1.0
            su += u
            sv += v
            sq += other
            suu += u * u
            suv += u * v
            svv += v * v
            suq += u * other
            svq += v * other
    suu -= su * su / count
    suv -= su * sv / count
    svv -= sv * sv / count
    suq -= su * sq / count
    svq -= sv * sq / count
    spread = suu * svv - suv * suv
    if spread <= LEAST_SPREAD * suu * svv or suu <= 0.0 or svv <= 0.0:
        return 0.0, 0.0, q
    right = (suq * svv - svq * suv) / spread
    down = (svq * suu - suq * suv) / spread
    mean = q + (sq - right * su - down * sv) / count
    return right / step, down / step, mean


def moved(depth: NDArray[np.float32], camera: Camera, other: Camera) -> NDArray[np.float64]:
    """Return how far each pixel's point of a still room, at ``depth`` [H, W] metres, moves from ``camera``'s picture to
    that of ``other``, float64 [2, H, W] pixels, x right, y up; 0 for no depth and for points behind ``other``."""
    pixels, ahead = other.project(camera.unproject(depth))
    to_right = pixels[..., 0] - (np.arange(camera.width) + 0.5)
    to_top = (np.arange(camera.height) + 0.5)[:, None] - pixels[..., 1]
    if other.projection == "equirectangular":  # the shorter way round
        to_right -= np.round(to_right / (2 * np.pi * other.fx)) * (2 * np.pi * other.fx)
    return np.where((depth > 0) & (ahead > 0), np.stack([to_right, to_top]), 0.0)


@dataclass(frozen=True, eq=False)
class Matte:
    """A Cryptomatte layer and its ranks, float32 [2 RANKS, H, W]: alternately id and coverage."""

    layer: MatteLayer
    ranks: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class BakedView:
    """Everything that is written for a view, as ``camera`` sees it. ``previous`` and ``following`` are the cameras of
    the frames before and after, if known. ``guessed`` float32 [H, W] is the share of each pixel that no photo ever saw,
    None if no objects were removed. ``normal`` float32 [3, H, W] is as in `Surface`, None if depth gives it."""

    camera: Camera
    layers: PanopticLayers
    mattes: tuple[Matte, ...]
    previous: Camera | None = None
    following: Camera | None = None
    guessed: NDArray[np.float32] | None = None
    normal: NDArray[np.float32] | None = None

    @property
    def surface(self) -> Surface:
        """Return the position and normal of each pixel, computed on demand."""
        if self.normal is None:
            return surface_of(self.layers.depth, self.camera)
        position = np.moveaxis(self.camera.unproject(self.layers.depth), -1, 0)
        return Surface(np.where(self.layers.depth > 0, position, 0.0).astype(np.float32), self.normal)

    @property
    def vectors(self) -> NDArray[np.float32]:
        """Return motion as in Blender's pass Vector, float32 [4, H, W]: from where a pixel is to where it was in the
        previous frame, and from where it will be in the next frame to where it is, in pixels, x right, y up. It is 0
        where nothing was rendered, where the other frame is not known, and where its camera has the point behind it."""
        was, will_be = (
            np.zeros((2, *self.layers.depth.shape)) if other is None else moved(self.layers.depth, self.camera, other)
            for other in (self.previous, self.following)
        )
        return np.concatenate([was, -will_be]).astype(np.float32)


@dataclass(frozen=True)
class ShownInstances:
    """The instances that pictures and passes show: their ``names`` by id. ``class_of`` is the one class of each, by id;
    None if every pixel decides on its own. ``unowned`` are the thing classes of which a correction left points without
    an object: their pixels may show no instance."""

    names: Mapping[int, str]
    class_of: Mapping[int, int] | None = None
    unowned: frozenset[int] = frozenset()

    @property
    def colours(self) -> dict[int, tuple[int, int, int]]:
        return {instance: distinct_colour(instance) for instance in self.names}


def bake_view(
    bands: Iterable[PanopticRendering], camera: Camera, classes: ClassTable, instances: ShownInstances
) -> BakedView:
    """Decide and rank ``bands`` (all rows of ``camera``'s picture, from the top) one after another, so that only one
    band's coverage is in memory. The bands are changed (see ``align_mattes``). Raises ValueError without bands."""
    shape = (2 * RANKS, camera.height, camera.width)
    of_instances, of_classes = np.empty(shape, np.float32), np.empty(shape, np.float32)
    layers: list[PanopticLayers] = []
    guessed: list[NDArray[np.float32]] = []
    row = 0
    for band in bands:
        layers.append(decide(band, classes, instances.class_of, unowned=instances.unowned))
        align_mattes(band, classes, instances.class_of, layers[-1])
        by_class = class_layer(band.class_ids, classes)
        rank_coverage(
            band.class_coverage, by_class.columns, by_class.ids, band.alpha, limit=None, out=of_classes, first_row=row
        )
        by_instance = instance_layer(band.instance_ids, instances.names, classes, instances.class_of)
        limit = things_coverage(band, classes) if instances.class_of is None else None
        columns, ids = by_instance.columns, by_instance.ids
        rank_coverage(band.instance_coverage, columns, ids, band.alpha, limit=limit, out=of_instances, first_row=row)
        row += len(band.alpha)
        guessed += [] if band.guessed is None else [band.guessed]
        del band  # frees its memory before the next is made
    if not layers:
        raise ValueError("no bands to bake")
    mattes = Matte(by_instance, of_instances), Matte(by_class, of_classes)
    return BakedView(camera, joined(layers), mattes, guessed=np.concatenate(guessed) if guessed else None)


def things_coverage(rendering: PanopticRendering, classes: ClassTable) -> NDArray[np.float32]:
    """Return how much of each pixel is covered by things, float32 [H, W].

    If every pixel decides on its own, stuff has instance probabilities too. So a pixel's instances together get no more
    than this coverage: at the edge of a chair before a wall the chair keeps its share, and instances of the wall get
    nothing. If an object has one class, its coverage is part of its class's."""
    things = [column for column, one in enumerate(rendering.class_ids) if one in classes.thing_ids]
    total = np.zeros_like(rendering.alpha)
    for column in things:
        total += rendering.class_coverage[..., column]
    return total


def joined(bands: list[PanopticLayers]) -> PanopticLayers:
    """Join all bands of rows into one, from the top."""
    if len(bands) == 1:
        return bands[0]
    return PanopticLayers(*map(np.concatenate, zip(*bands, strict=True)))
