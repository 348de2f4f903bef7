"""Semantic points and anchors as Blender point clouds, and the spacing and normals of surface points, with which a
camera can look into a room from outside.

Solid shading has one colour per object, so each class of semantic points is a cloud in the class's colour. The photos'
colours are in the attribute Col, which the material shows in Cycles and EEVEE. Spacing and normals come from one grid
of small cells instead of a neighbour search, so a million points take only a moment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.corrections import entropy_of
from ..engine.posed import VOID, ClassTable
from ..engine.result_files import Anchors, SemanticPoints, read_arrays
from .compat import new_point_clouds
from .materials import UNKNOWN, linear_rgba, object_colour, point_material
from .owned import OwnedDataBlocks, child_collection, tag

_CELL = 4.0
"""Side of a cell, in point spacings. A cell then holds about sixteen points, enough to fit a plane."""
_TOUCHING = 0.75
"""Radius, in spacings, at which neighbours touch; more than half, because points are not evenly spread."""
_AT_ONCE = 8192
"""Number of cells whose distances are measured at once, so that they fit into the processor's cache."""
_THICKNESS = 0.3
"""A cell's points count as a plane if the third variance is at most this fraction of the second."""


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """Points `xyz` float [N, 3] sorted into the cells of a grid: `cell` int [N] is each point's cell, `count` int [C]
    the points per cell. `side` is the length of a cell in the points' unit. It is 0 if there are too few points to have
    a spacing; they then share one cell."""

    xyz: NDArray[np.floating]
    cell: NDArray[np.int64]
    count: NDArray[np.int64]
    side: float

    @classmethod
    def of(cls, xyz: NDArray[np.floating]) -> SurfaceGrid:
        spacing = _point_spacing(xyz)
        if spacing == 0.0:
            return cls(xyz, np.zeros(len(xyz), np.int64), np.array([len(xyz)]), 0.0)
        side = spacing * _CELL
        _, cell, count = np.unique(_cell_numbers(xyz, side), return_inverse=True, return_counts=True)
        return cls(xyz, cell.ravel(), count, side)

    @property
    def spacing(self) -> float:
        """The typical distance between neighbours, in the points' unit."""
        return self.side / _CELL

    def radii(self, smallest: float, largest: float) -> NDArray[np.float32]:
        """Return radii float32 [N], at which points just touch, within limits (in the points' unit)."""
        # A surface crosses a cell with about a face's area. Cells that it only grazes have few points.
        local = np.minimum(self.side / np.sqrt(np.maximum(self.count, 1)), 2.0 * self.spacing)
        return np.clip(_TOUCHING * local, smallest, largest).astype(np.float32)[self.cell]

    def beside(self, positions: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the index of a point in the cell of each position [M, 3], int64 [M]; -1 for empty cells."""
        if self.side == 0.0:
            return np.full(len(positions), -1, np.int64)
        low, high = self.xyz.min(axis=0), self.xyz.max(axis=0)
        inside = ((positions >= low) & (positions <= high)).all(axis=1)
        both = np.concatenate([self.xyz, np.where(inside[:, None], positions, low)])  # numbers depend on all of them
        numbers = _cell_numbers(both, self.side)
        known, first = np.unique(numbers[: len(self.xyz)], return_index=True)
        at = np.minimum(np.searchsorted(known, numbers[len(self.xyz) :]), len(known) - 1)
        return np.where(inside & (known[at] == numbers[len(self.xyz) :]), first[at], -1)

    def normals(self, viewpoints: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return unit normals float32 [N, 3] of points that were seen from viewpoints [V, 3]; zeros without viewpoints.
        A plane is fitted to each cell's points and turned towards the nearest viewpoint, because scanned surfaces face
        their cameras. If no plane fits, the normal is the direction to that viewpoint. This is coarse, but it tells the
        two sides of a wall apart."""
        if self.side == 0.0 or not len(viewpoints):
            return np.zeros((len(self.xyz), 3), np.float32)
        mean, spread = self._moments()
        lengths, axes = np.linalg.eigh(spread)
        normal = axes[:, :, 0]
        towards = towards_nearest(mean, viewpoints)
        normal *= np.where(np.einsum("ij,ij->i", normal, towards) < 0.0, -1.0, 1.0)[:, None]
        no_plane = (self.count < 4) | (lengths[:, 0] > _THICKNESS * lengths[:, 1])  # three points always lie in a plane
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        normal[no_plane] = (towards / np.maximum(distance, 1e-9))[no_plane]
        return normal.astype(np.float32)[self.cell]

    def _moments(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mean [C, 3] and covariance [C, 3, 3] of the points of each cell."""
        middle = self.xyz.mean(axis=0, dtype=np.float64)  # sums of squares lose digits far from the origin
        local = [self.xyz[:, axis] - middle[axis] for axis in range(3)]
        mean = np.stack([np.bincount(self.cell, column) / self.count for column in local], axis=1)
        spread = np.empty((len(self.count), 3, 3))
        for row in range(3):
            for column in range(row, 3):
                product = np.bincount(self.cell, local[row] * local[column]) / self.count
                spread[:, row, column] = spread[:, column, row] = product - mean[:, row] * mean[:, column]
        return mean + middle, spread


def _point_spacing(xyz: NDArray[np.floating]) -> float:
    """Return the typical distance between neighbours, from the cells that surfaces cross; 0 if all points coincide."""
    if len(xyz) < 2:
        return 0.0
    extent = float(max(np.ptp(xyz[:, axis]) for axis in range(3)))
    if extent == 0.0:
        return 0.0
    # Cells that hold about two dozen points: fine enough to follow surfaces, coarse enough to have no gaps.
    side = extent / max(1.0, np.sqrt(len(xyz) / 24.0))
    numbers = np.sort(_cell_numbers(xyz, side))
    occupied = 1 + np.count_nonzero(numbers[1:] != numbers[:-1])
    return side * float(np.sqrt(occupied / len(xyz)))


def _cell_numbers(xyz: NDArray[np.floating], side: float) -> NDArray[np.int64]:
    """Return the number of each point's cell, int64 [N], in a grid whose cells have this side."""
    numbers = np.zeros(len(xyz), np.int64)
    for axis in range(3):
        column = xyz[:, axis]
        cells = ((column - column.min()) / side).astype(np.int64)
        numbers = numbers * (int(cells.max()) + 1) + cells
    return numbers


def towards_nearest(points: NDArray[np.float64], viewpoints: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the vectors [N, 3] from each point to its nearest viewpoint."""
    middle = viewpoints.mean(axis=0)  # differences of squares lose digits far from the origin
    views = viewpoints - middle
    nearest = np.empty(len(points), np.int64)
    for start in range(0, len(points), _AT_ONCE):
        # |view - point|² less |point|², which is the same for all views.
        part = slice(start, start + _AT_ONCE)
        distance = np.einsum("ij,ij->i", views, views) - 2.0 * (points[part] - middle) @ views.T
        nearest[part] = distance.argmin(axis=1)
    return viewpoints[nearest] - points


_SMALLEST, _LARGEST = 0.002, 0.03  # limits of a point's radius in metres
Attributes = dict[str, tuple[str, NDArray[Any]]]
"""The type and the values [N, ...] of each attribute of N points, by name."""
_FIELDS = {
    "FLOAT": "value", "INT": "value", "FLOAT_VECTOR": "vector", "FLOAT4": "vector", "QUATERNION": "value",
    "FLOAT_COLOR": "color", "BYTE_COLOR": "color_srgb",
}  # fmt: skip
"""What `foreach_set` calls the values of a type."""


def set_attributes(data: bpy.types.PointCloud | bpy.types.Mesh, attributes: Attributes) -> None:
    """Fill attributes of a cloud's points or a mesh's vertices, and make those that are missing."""
    for name, (kind, values) in attributes.items():
        layer = data.attributes.get(name) or data.attributes.new(name, kind, "POINT")
        layer.data.foreach_set(_FIELDS[kind], np.ascontiguousarray(values).ravel())


def place_semantic_points(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    points: SemanticPoints,
    *,
    grid: SurfaceGrid,
    normals: NDArray[np.float32],
    classes: ClassTable,
) -> list[bpy.types.Object]:
    """Place one cloud for each class that has points, with Col, class_id, instance_id, confidence, entropy (in bits,
    between the winner and all other labels) and `normals` [N, 3]. The `grid` of the points gives their radii."""
    radius = grid.radii(_SMALLEST, _LARGEST)
    placed = []
    # Sorted once, each class is one run. Comparing every point with every class takes a second with a million.
    order, (ids, counts) = np.argsort(points.class_id, kind="stable"), np.unique(points.class_id, return_counts=True)
    groups = [*zip(ids.tolist(), np.split(order, np.cumsum(counts)), strict=False)]  # split adds an empty part
    of = {one.id: (one.name, one.colour) for one in classes.categories if one.id != VOID}
    looks = [of.get(class_id, ("unknown", UNKNOWN)) for class_id, _ in groups]
    clouds = new_point_clouds([f"{name} points" for name, _ in looks], [points.xyz[chosen] for _, chosen in groups])
    for (class_id, chosen), (name, srgb), cloud in zip(groups, looks, clouds, strict=True):
        attributes = _label_attributes(points, chosen) | {"normal": ("FLOAT_VECTOR", normals[chosen])}
        key, shown = f"class:{class_id}", f"{name} points"
        ob = _place(owned, parent, key, shown, cloud=cloud, radius=radius[chosen], attributes=attributes)
        ob.color = object_colour(srgb)
        ob["class"], ob["class_id"], ob["points"] = name, class_id, len(chosen)
        placed.append(ob)
    return placed


def place_anchors(owned: OwnedDataBlocks, parent: bpy.types.Collection, anchors: Anchors) -> bpy.types.Object:
    """Place one cloud of all anchors, with Col, class_id, instance_id, opacity and level."""
    radius = SurfaceGrid.of(anchors.xyz).radii(_SMALLEST, _LARGEST)
    attributes: Attributes = {
        "Col": ("FLOAT_COLOR", linear_rgba(anchors.rgb)),
        "class_id": ("INT", anchors.class_id),
        "instance_id": ("INT", anchors.instance_id),
        "opacity": ("FLOAT", anchors.opacity),
        "level": ("INT", anchors.level),
    }
    (cloud,) = new_point_clouds(["Anchors"], [anchors.xyz])
    ob = _place(owned, parent, "anchors", "Anchors", cloud=cloud, radius=radius, attributes=attributes)
    ob.color = (0.8, 0.8, 0.8, 1.0)
    ob["points"] = len(anchors.xyz)
    return ob


def cloud_folder(lift: Path) -> Path:
    """Return the folder into which the engine exports depth clouds for Blender."""
    return lift / "exports" / "clouds"


def place_depth_clouds(owned: OwnedDataBlocks, root: bpy.types.Collection, lift: Path) -> int:
    """Place the depth clouds made of a lift, and return their number of points. Raises PlgsError for a bad file."""
    count = 0
    for path in sorted(cloud_folder(lift).glob("*.npz")):
        points = read_arrays(path, SemanticPoints)
        radius = SurfaceGrid.of(points.xyz).radii(_SMALLEST, _LARGEST)
        parent, key = child_collection(root, "Depth clouds"), f"depth_cloud:{path.stem}"
        name, attributes = f"depth of {path.stem}", _label_attributes(points)
        (cloud,) = new_point_clouds([name], [points.xyz])
        ob = _place(owned, parent, key, name, cloud=cloud, radius=radius, attributes=attributes)
        ob["frame"], ob["points"] = path.stem, len(points.xyz)
        count += len(points.xyz)
    return count


def _label_attributes(points: SemanticPoints, rows: NDArray[np.int64] | slice = slice(None)) -> Attributes:
    """Return the attributes (class_id, instance_id and others), by name, of these ``rows`` of labelled points."""
    return {
        "Col": ("FLOAT_COLOR", linear_rgba(points.rgb[rows])),
        "class_id": ("INT", points.class_id[rows]),
        "instance_id": ("INT", points.instance_id[rows]),
        "confidence": ("FLOAT", points.confidence[rows]),
        "entropy": ("FLOAT", entropy_of(points.confidence[rows]).astype(np.float32)),
    }


def _place(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    *,
    cloud: bpy.types.PointCloud,
    radius: NDArray[np.float32],
    attributes: Attributes,
) -> bpy.types.Object:
    """Return our cloud object `key`, made if missing, with these attributes and radii float32 [N] in metres."""
    tag(cloud, owned.lift, key)
    set_attributes(cloud, {"radius": ("FLOAT", radius), **attributes})
    cloud.materials.append(point_material(owned))
    return owned.object(key, name, cloud, parent)
