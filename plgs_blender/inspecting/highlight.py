"""Draw highlights in a 3D view: the outline of the selected instance, and that of a mask. Points are read once per
selection, and an outline is computed once per view, because views are drawn often."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .drawing import Colour, Mark
from .selection import clouds_of, ids_of, values_of

_LINE = 0.95  # opacity of the outline
_KEPT = 2  # number of outlines drawn at once: the selection and the painted points
_WIDTH = 2.0  # width of the outline in pixels
_MOST_CELLS = 400 * 400  # an outline that covers more pixels is computed on a coarser grid
_CELLS_A_POINT = 3.0  # maximum radius of a point, in cells
_CLOSED = 2  # cells by which gaps between points are closed


@dataclass(frozen=True, eq=False)
class Highlight:
    """An instance's points: `xyz` float32 [N, 3] and their mean `radius` in metres; `key` names it and its clouds."""

    key: tuple[Any, ...]
    xyz: NDArray[np.float32]
    radius: float


_last: list[Highlight] = []
_last_marks: list[Mark] = []


def highlight_of(root: bpy.types.Collection, instance: int, visible: Any) -> Highlight:
    """Return the points of an instance in the clouds for which `visible(object)` is true."""
    clouds = [cloud for cloud in clouds_of(root) if visible(cloud)]
    states = [(cloud.data.session_uid, len(cloud.data.points), *map(tuple, cloud.matrix_world)) for cloud in clouds]
    key = (root.session_uid, instance, *states)
    if not _last or _last[0].key != key:
        parts = [_points_of(cloud, instance) for cloud in clouds]
        xyz, radius = (np.concatenate([each[at] for each in parts]) if parts else np.zeros((0, 3)) for at in (0, 1))
        _last[:] = [Highlight(key, xyz.astype(np.float32), float(radius.mean()) if len(radius) else 0.0)]
    return _last[0]


def highlight_of_mesh(root: bpy.types.Collection, ob: bpy.types.Object) -> Highlight:
    """Return the vertices of an instance's triangle mesh, and the middles of its edges and triangles: these are so
    dense that their outline is the mesh's own."""
    data = ob.data
    key = (root.session_uid, ob.session_uid, len(data.vertices), *map(tuple, ob.matrix_world))
    if not _last or _last[0].key != key:
        xyz, world = values_of(data, "position"), np.array(ob.matrix_world, np.float32)
        xyz = xyz @ world[:3, :3].T + world[:3, 3]
        edges, corners = np.empty(2 * len(data.edges), np.int32), np.empty(len(data.loops), np.int32)
        data.edges.foreach_get("vertices", edges)
        data.loops.foreach_get("vertex_index", corners)
        ends = xyz[edges.reshape(-1, 2)]
        length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        points = np.concatenate([xyz, ends.mean(axis=1), xyz[corners.reshape(-1, 3)].mean(axis=1)])
        _last[:] = [Highlight(key, points, float(np.median(length)) / 8.0 if len(length) else 0.0)]
    return _last[0]


def forget() -> None:
    """Forget the computed outlines of points, so that they are computed anew."""
    _last.clear()
    _last_marks.clear()


def _points_of(cloud: bpy.types.Object, instance: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return world positions [n, 3] and radii [n] of an instance's points in a cloud."""
    mine = ids_of(cloud.data, "instance_id") == instance
    world = np.array(cloud.matrix_world, np.float32)
    xyz = values_of(cloud.data, "position")[mine] @ world[:3, :3].T + world[:3, 3]
    return xyz, values_of(cloud.data, "radius", "value", 1)[mine, 0]


def mark_of(seen: Highlight, view: Any, size: tuple[int, int], colour: Colour, tint: float = 0.1) -> Mark | None:
    """Return the outline of points in a view (a RegionView3D) of `size` pixels, in an sRGB colour, filled with opacity
    `tint`; None if no point is in the view. Nearer things do not hide it, as with Blender's own outlines."""
    lens, looks = np.array(view.window_matrix, np.float32), np.array(view.view_matrix, np.float32)
    key = (seen.key, lens.tobytes(), looks.tobytes(), size, colour)
    for mark in _last_marks:
        if mark.key == key:
            return mark
    clip = np.c_[seen.xyz, np.ones(len(seen.xyz), np.float32)] @ (lens @ looks).T
    clip = clip[(clip[:, 3] > 1e-3) & (np.abs(clip[:, :2]) < clip[:, 3:]).all(axis=1)]
    if not len(clip):
        return None
    place = (clip[:, :2] / clip[:, 3:] * 0.5 + 0.5) * size
    reach = max(1.0, float(np.median(seen.radius * lens[0, 0] * size[0] / 2.0 / clip[:, 3])))
    low, extent = place.min(axis=0), np.ptp(place, axis=0) + 1.0
    cell = max(1.0, reach / _CELLS_A_POINT, float(np.sqrt(extent.prod() / _MOST_CELLS)))
    grown, line = int(np.ceil(reach / cell)) + _CLOSED, max(1, round(_WIDTH / cell))
    margin = grown + line + 1  # cells around the points, into which they grow
    column, row = ((place - low) / cell).astype(np.int64).T + margin
    inside = np.zeros((row.max() + margin + 1, column.max() + margin + 1), bool)
    inside[row, column] = True
    inside = ~_grown(~_grown(inside, grown), _CLOSED)  # as large as the points are drawn, without the gaps
    pixels = np.empty((*inside.shape, 4), np.float32)
    pixels[..., :3] = colour
    pixels[..., 3] = np.where(inside, tint, np.where(_grown(inside, line), _LINE, 0.0))
    left, base = (low - margin * cell).tolist()
    mark = Mark(key, pixels, (left, base, left + cell * inside.shape[1], base + cell * inside.shape[0]))
    _last_marks[:] = [mark, *_last_marks[: _KEPT - 1]]
    return mark


def _grown(mask: NDArray[np.bool_], times: int) -> NDArray[np.bool_]:
    """Return a mask [H, W] grown by this many cells, by crosses and squares in turn, which keeps corners round."""
    for step in range(times):
        wide = mask.copy()
        wide[:, 1:] |= mask[:, :-1]
        wide[:, :-1] |= mask[:, 1:]
        tall = wide.copy()
        before = wide if step % 2 else mask
        tall[1:] |= before[:-1]
        tall[:-1] |= before[1:]
        mask = tall
    return mask


def outline_in_space(
    camera: bpy.types.Object, outline: str, rectangle: tuple[float, float, float, float]
) -> list[list[Vector]]:
    """Return the polygons of a mask's ``outline`` (of its ``rectangle`` without one; see `MatchedSegment`) as world
    points one metre in front of a frame's camera; [] if the user removed the lens properties from the camera."""
    if any(name not in camera for name in ("width", "height", "fx", "fy", "cx", "cy")):
        return []

    def in_space(u: float, v: float) -> Vector:
        x = (u * camera["width"] - camera["cx"]) / camera["fx"]
        y = (v * camera["height"] - camera["cy"]) / camera["fy"]
        return camera.matrix_world @ Vector((x, -y, -1.0))  # a Blender camera looks along -z with y up

    left, top, right, bottom = rectangle
    polygons = [[corner.split(",") for corner in polygon.split()] for polygon in outline.split(";") if polygon]
    found = [[(float(u), float(v)) for u, v in polygon] for polygon in polygons]
    found = found or [[(left, top), (right, top), (right, bottom), (left, bottom)]]
    return [[in_space(u, v) for u, v in polygon] for polygon in found]
