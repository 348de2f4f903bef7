"""The semantic points and the anchors as Blender point clouds.

Solid shading has one colour for each object, so each class of semantic points is a cloud in the class's colour. The
photo's colours are in the attribute Col, which the material shows in Cycles and EEVEE.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.corrections import entropy_of
from ..engine.posed import VOID, ClassTable
from ..engine.result_files import Anchors, SemanticPoints, read_arrays
from .compat import new_point_clouds
from .lift_collection import child_collection
from .materials import UNKNOWN, linear_rgba, object_colour, point_material
from .owned import OwnedDataBlocks, tag
from .surfaces import SurfaceGrid

_SMALLEST, _LARGEST = 0.002, 0.03
"""Limits to the radius of a point, metres."""
Attributes = list[tuple[str, str, NDArray[Any]]]
_FOREACH = {"FLOAT_COLOR": "color", "FLOAT_VECTOR": "vector", "INT": "value", "FLOAT": "value"}


def place_semantic_points(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    points: SemanticPoints,
    grid: SurfaceGrid,
    normals: NDArray[np.float32],
    classes: ClassTable,
) -> list[bpy.types.Object]:
    """One cloud for each class that has points, with Col, class_id, instance_id, confidence, entropy (bits of doubt
    between the winner and all else) and normal [N, 3]."""
    radius = grid.radii(_SMALLEST, _LARGEST)
    placed, groups = [], [*_groups(points.class_id)]
    looks = [_name_and_colour(class_id, classes) for class_id, _ in groups]
    clouds = new_point_clouds([name for name, _ in looks], [points.xyz[chosen] for _, chosen in groups])
    for (class_id, chosen), (name, srgb), cloud in zip(groups, looks, clouds, strict=True):
        attributes = [*_label_attributes(points, chosen), ("normal", "FLOAT_VECTOR", normals[chosen])]
        ob = _place(owned, parent, f"class:{class_id}", name, cloud, radius[chosen], attributes)
        ob.color = object_colour(srgb)
        ob["class"], ob["class_id"], ob["points"] = name, class_id, len(chosen)
        placed.append(ob)
    return placed


def place_anchors(owned: OwnedDataBlocks, parent: bpy.types.Collection, anchors: Anchors) -> bpy.types.Object:
    """One cloud of all anchors, with Col, class_id, instance_id, opacity and level."""
    radius = SurfaceGrid.of(anchors.xyz).radii(_SMALLEST, _LARGEST)
    attributes = [
        ("Col", "FLOAT_COLOR", linear_rgba(anchors.rgb)),
        ("class_id", "INT", anchors.class_id),
        ("instance_id", "INT", anchors.instance_id),
        ("opacity", "FLOAT", anchors.opacity),
        ("level", "INT", anchors.level),
    ]
    (cloud,) = new_point_clouds(["Anchors"], [anchors.xyz])
    ob = _place(owned, parent, "anchors", "Anchors", cloud, radius, attributes)
    ob.color = (0.8, 0.8, 0.8, 1.0)
    ob["points"] = len(anchors.xyz)
    return ob


def cloud_folder(lift: Path) -> Path:
    """The folder into which the engine exports depth clouds for Blender."""
    return lift / "exports" / "clouds"


def place_depth_clouds(owned: OwnedDataBlocks, root: bpy.types.Collection, lift: Path) -> int:
    """Place the depth clouds that were made of the lift, one object per frame. Returns the number of points. Raises
    PlgsError for a damaged file."""
    count = 0
    for path in sorted(cloud_folder(lift).glob("*.npz")):
        points = read_arrays(path, SemanticPoints)
        radius = SurfaceGrid.of(points.xyz).radii(_SMALLEST, _LARGEST)
        parent, key = child_collection(root, "Depth clouds"), f"depth_cloud:{path.stem}"
        name, attributes = f"depth of {path.stem}", _label_attributes(points)
        (cloud,) = new_point_clouds([name], [points.xyz])
        ob = _place(owned, parent, key, name, cloud, radius, attributes)
        ob["frame"], ob["points"] = path.stem, len(points.xyz)
        count += len(points.xyz)
    return count


def _label_attributes(points: SemanticPoints, rows: NDArray[np.int64] | slice = slice(None)) -> Attributes:
    """What every labelled point carries."""
    return [
        ("Col", "FLOAT_COLOR", linear_rgba(points.rgb[rows])),
        ("class_id", "INT", points.class_id[rows]),
        ("instance_id", "INT", points.instance_id[rows]),
        ("confidence", "FLOAT", points.confidence[rows]),
        ("entropy", "FLOAT", entropy_of(points.confidence[rows]).astype(np.float32)),
    ]


def _groups(values: NDArray[np.integer]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each value of an array [N] with the indices of its elements, both in ascending order."""
    # Sorted once, each value is one run. Comparing every point with every value takes a second with a million.
    order = np.argsort(values, kind="stable")
    found, counts = np.unique(values, return_counts=True)
    yield from zip(found.tolist(), np.split(order, np.cumsum(counts)), strict=False)


def _place(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    cloud: bpy.types.PointCloud,
    radius: NDArray[np.float32],
    attributes: Attributes,
) -> bpy.types.Object:
    """Our cloud object `key` with these points, radii float32 [N] in metres, and attributes (name, type, values [N,
    ...]).
    """
    tag(cloud, owned.lift, key)
    sizes = cloud.attributes.get("radius") or cloud.attributes.new("radius", "FLOAT", "POINT")
    sizes.data.foreach_set("value", radius)
    for attribute, kind, values in attributes:
        layer = cloud.attributes.new(attribute, kind, "POINT")
        layer.data.foreach_set(_FOREACH[kind], np.ascontiguousarray(values).ravel())
    cloud.materials.append(point_material(owned))
    return owned.object(key, name, cloud, parent)


def _name_and_colour(class_id: int, classes: ClassTable) -> tuple[str, tuple[int, int, int]]:
    if class_id == VOID or class_id not in classes:
        return "unknown", UNKNOWN
    return classes[class_id].name, classes[class_id].colour
