"""Meshes of squares, which have a colour each in Solid shading too: splats, and points without classes.

Their attributes are Col, opacity and, where the material fades the squares from the middle, corner: the place of a
vertex on its square, in standard deviations of a Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping

import bpy
import numpy as np
from numpy.typing import NDArray

from .materials import linear_rgba, splat_material
from .owned import OwnedDataBlocks
from .surfaces import SurfaceGrid

MOST_SQUARES = 600_000
"""Squares that splats have at most."""
_MOST_POINTS = 300_000
"""Squares that points have at most: the window waits for them."""
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
"""Of a square, in half its sides."""
_SMALLEST, _LARGEST = 0.002, 0.03
"""Limits to half the side of a point's square, metres."""
_KINDS = {"Col": "FLOAT_COLOR", "corner": "FLOAT_VECTOR", "opacity": "FLOAT", "class_id": "INT", "instance_id": "INT"}
_FIELDS = {"position": "vector", "corner": "vector", "Col": "color"}


def place_points(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    points: tuple[NDArray[np.float32], NDArray[np.uint8]],
    viewpoints: NDArray[np.float64],
) -> bpy.types.Object:
    """Place points without classes, xyz [N, 3] metres and rgb [N, 3] sRGB, as one mesh of squares that face the
    viewpoints [V, 3]. Of more than _MOST_POINTS points, evenly many are left out.
    """
    xyz, rgb = points
    if len(xyz) > _MOST_POINTS:
        chosen = np.linspace(0, len(xyz) - 1, _MOST_POINTS).astype(np.int64)
        xyz, rgb = xyz[chosen], rgb[chosen]
    grid = SurfaceGrid.of(xyz)
    columns = sides(len(xyz)) | {
        "position": _facing(xyz, grid.radii(_SMALLEST, _LARGEST), grid.normals(viewpoints)).ravel(),
        "Col": np.repeat(linear_rgba(rgb), 4, axis=0).ravel(),
        "opacity": np.ones(4 * len(xyz), np.float32),
    }
    ob = owned.object(key, name, fill_squares(owned, key, name, columns), parent)
    ob["points"] = len(xyz)
    return ob


def _facing(xyz: NDArray[np.float32], half: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Corners [N, 4, 3] of the squares around points xyz [N, 3], with half a side [N], across normals [N, 3]."""
    upright = np.abs(normals[:, 2]) < 0.9
    other = np.where(upright[:, None], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(other, normals)
    first *= (half / np.maximum(np.linalg.norm(first, axis=1), 1e-9))[:, None]
    own = np.stack([first, np.cross(normals, first)], axis=1)
    return (xyz[:, None] + np.einsum("ca,naj->ncj", CORNERS, own)).astype(np.float32)


def sides(count: int) -> dict[str, NDArray[np.generic]]:
    """The sides of the squares: attributes that Blender's meshes have of themselves."""
    numbers = np.arange(4 * count, dtype=np.int32)
    ends = np.stack([numbers, numbers + np.tile(np.array([1, 1, 1, -3], np.int32), count)], axis=1)
    return {".corner_vert": numbers, ".corner_edge": numbers, ".edge_verts": ends.ravel()}


def fill_squares(
    owned: OwnedDataBlocks, key: str, name: str, columns: Mapping[str, NDArray[np.generic]]
) -> bpy.types.Mesh:
    """Our mesh `key` of squares with `sides` and these attributes, flat, of its vertices [4 N]."""
    count = len(columns["opacity"]) // 4
    mesh: bpy.types.Mesh = owned.data(key, lambda: bpy.data.meshes.new(name))
    mesh.clear_geometry()
    mesh.vertices.add(4 * count)
    mesh.loops.add(4 * count)
    mesh.edges.add(4 * count)
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 4 * count, 4, dtype=np.int32))
    for attribute in columns.keys() & _KINDS.keys():
        mesh.attributes.new(attribute, _KINDS[attribute], "POINT")
    # Attributes are copied at once. What `vertices` and `loops` call co and vertex_index would be set one by one.
    for attribute, values in columns.items():
        mesh.attributes[attribute].data.foreach_set(_FIELDS.get(attribute, "value"), values)
    mesh.color_attributes.active_color = mesh.color_attributes["Col"]
    mesh.materials.clear()
    mesh.materials.append(splat_material(owned))
    mesh.update()
    return mesh
