"""Find what a 3D view draws of a lift at a pixel: the first triangle, square, splat or point that a ray meets.

An object is projected when the mouse comes near it, and cached until the view or the object changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from ..materials import DENSER
from ..meshes import CORRECTIONS
from ..splat_objects import EXTENT, axes_of
from ..splat_objects import NAME as OPEN_ROOM
from .looks import leaving_out
from .selection import clouds_of, ids_of, surfaces_of, values_of

NEAREST = 0.01
"""Near clipping distance of views of a lift, in metres."""
MISS = 8
"""If nothing is drawn under the mouse, an instance within this many pixels is taken."""
_OFFSETS = np.stack(np.meshgrid(*[np.arange(-MISS, MISS + 1)] * 2), axis=-1).reshape(-1, 2).astype(np.float32)
_OFFSETS = _OFFSETS[np.hypot(*_OFFSETS.T) <= MISS]
_OFFSETS = _OFFSETS[np.argsort(np.hypot(*_OFFSETS.T), kind="stable")]
"""Offsets of the pixels within MISS, nearest first."""
_DRAWN = 0.5  # opacity, accumulated from the front, at which something counts as drawn
_COVER = 1.5
"""Radii that a point covers: surface points leave gaps otherwise, through which clicks would fall."""
_NATIVE_EXTENT = 3.0  # extent of Blender's own splats, in standard deviations
TRIANGLE, SQUARE, SPLAT, POINT = "TRIANGLE", "SQUARE", "SPLAT", "POINT"


Rows = tuple[tuple[float, ...], ...]


def rows_of(matrix: Matrix) -> Rows:
    """Return a matrix as a tuple of rows, which can be hashed."""
    return tuple(map(tuple, matrix))


@dataclass(frozen=True)
class View:
    """How a view of `width` by `height` pixels draws: its view and window matrices (`looks`, `lens`), as in
    RegionView3D; the world position `eye` of the scene's camera, which decides which walls of points are removed;
    whether backs are hidden; and whether squares fade, which they do not in Solid shading."""

    looks: Rows
    lens: Rows
    width: int
    height: int
    eye: tuple[float, float, float] = (0.0, 0.0, 0.0)
    are_backs_open: bool = True
    is_fading: bool = True

    @classmethod
    def of(cls, region_data: Any, size: tuple[int, int], scene: bpy.types.Scene, space: Any = None) -> View:
        shading = space.shading if space is not None else None
        is_solid = shading is not None and shading.type in ("SOLID", "WIREFRAME")
        eye = scene.camera.matrix_world.translation if scene.camera is not None else Vector()
        looks, lens = rows_of(region_data.view_matrix), rows_of(region_data.window_matrix)
        are_backs_open = shading is None or not is_solid or shading.show_backface_culling
        return cls(looks, lens, *size, tuple(eye), are_backs_open, not is_solid)

    def projected(self, xyz: NDArray[np.float32], world: Matrix) -> NDArray[np.float32]:
        """Project positions [N, 3] to X, Y, W and Z, float32 [N, 4]: they appear at the pixel X / W, Y / W, if W > 0,
        and Z is their coordinate in metres along the view's axis, which points to the viewer. All four are linear in
        the position."""
        to_eye = Matrix(self.looks) @ world
        whole, along = np.array(Matrix(self.lens) @ to_eye, np.float32), np.array(to_eye[2], np.float32)
        x, y, _, w = whole[:, :3] @ xyz.T + whole[:, 3:]
        half = np.float32(self.width / 2.0), np.float32(self.height / 2.0)
        return np.stack([half[0] * (w + x), half[1] * (w + y), w, along[:3] @ xyz.T + along[3]], axis=1)


@dataclass(frozen=True, eq=False)
class Projected:
    """N flat elements (squares, splats, triangles) of one `form`, projected into a view. `corners` int32 [N, 3] are
    rows of `vertices` [M, 4], from `View.projected`: an element's origin and the ends of its two axes. `bounds` [4, N]
    in pixels: left, bottom, right, top. `ids` int32 [N, 2]: instance, class. `opacity` float32 [N] at its middle."""

    form: str
    vertices: NDArray[np.float32]
    corners: NDArray[np.int32]
    bounds: NDArray[np.float32]
    ids: NDArray[np.int32]
    opacity: NDArray[np.float32] | None = None

    def at(self, pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
        """Return what the elements that may cover one of the pixels [P, 2] show at each: opacities and nearness,
        float32 [P, n] each, and the elements' ids int32 [n, 2]."""
        (left, low), (right, high) = pixels.min(axis=0), pixels.max(axis=0)
        bounds = self.bounds
        rows = np.flatnonzero((bounds[0] <= right) & (bounds[2] >= left) & (bounds[1] <= high) & (bounds[3] >= low))
        places = self.vertices[self.corners[rows]]
        begin, first, second = places[:, 0], places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
        # X - x W = 0 and Y - y W = 0 at the pixel (x, y), both linear in the shares of the axes.
        (x, y), (a, b), (c, d) = (
            [each[:, axis] - pixels[:, None, axis] * each[:, 2] for axis in (0, 1)] for each in (begin, first, second)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            along, aside = (y * c - x * d) / (a * d - b * c), (x * b - y * a) / (a * d - b * c)
            if self.form == POINT:  # a pyramid: its four sides rise towards the eye
                along, aside = np.abs(along), np.abs(aside)
            w, near = (begin[:, at] + along * first[:, at] + aside * second[:, at] for at in (2, 3))
            return np.where(w > NEAREST, self._opacities(along, aside, rows), 0.0), near, self.ids[rows]

    def _opacities(self, first: Any, second: Any, rows: NDArray[np.int64]) -> Any:
        if self.form == TRIANGLE:
            return np.float32((first >= 0.0) & (second >= 0.0) & (first + second <= 1.0))
        if self.form == POINT:
            return np.float32(first**2 + second**2 <= _COVER**2)
        extent, deviations, denser = (1.0, EXTENT, DENSER) if self.form == SQUARE else (_NATIVE_EXTENT, 1.0, 1.0)
        is_within = (np.abs(first) <= extent) & (np.abs(second) <= extent)
        if self.opacity is None:
            return np.float32(is_within)
        alpha = denser * self.opacity[rows] * np.exp(-0.5 * deviations**2 * (first**2 + second**2))
        return np.where(is_within, np.minimum(alpha, 1.0), 0.0).astype(np.float32)


def first_drawn(parts: Sequence[Projected], mouse: tuple[float, float]) -> tuple[int, int, int] | None:
    """Return an index in `parts`, an instance and a class: what is drawn at the pixel ``mouse``, else the nearest
    instance within MISS pixels of it; None if there is neither."""
    for offsets in (_OFFSETS[:1], _OFFSETS[1:]) if parts else ():  # most often the mouse's own pixel is drawn
        found = [part.at(np.array(mouse, np.float32) + offsets) for part in parts]
        opacities, near = (np.concatenate([each[column] for each in found], axis=1) for column in (0, 1))
        ids = np.concatenate([each[2] for each in found])
        part_of = np.repeat(np.arange(len(parts)), [len(each[2]) for each in found])
        for pixel, opacity in enumerate(opacities):
            covering = np.flatnonzero(opacity > 0.0)
            covering = covering[np.argsort(-near[pixel, covering], kind="stable")]
            at = int(np.searchsorted(1.0 - np.cumprod(1.0 - opacity[covering]), _DRAWN))  # sorted, as it grows
            if at < len(covering) and (len(offsets) == 1 or ids[covering[at], 0] > 0):
                return int(part_of[covering[at]]), *ids[covering[at]].tolist()
    return None


cached: dict[int, tuple[tuple[Any, ...], Projected]] = {}
"""Projected objects by session uid, with the states of their lift, of themselves and of the view."""
_MOST_KEPT = 64


def parts_near(
    root: bpy.types.Collection, view: View, mouse: tuple[float, float], space: Any = None
) -> list[Projected]:
    """Return the parts of a lift that a view draws near a pixel, projected. What `space` hides is left out."""
    lists = root.plgs
    hidden = tuple(row.visible for row in (*lists.instances, *lists.classes))
    state = view, lists.isolated, hidden, root.get(CORRECTIONS)
    found = []
    for ob in dict.fromkeys((*clouds_of(root), *surfaces_of(root))):
        if not ob.visible_get(viewport=space) or "class_id" not in ob.data.attributes or not _is_near(ob, view, mouse):
            continue
        key = *state, ob.data.session_uid, len(ob.data.attributes["position"].data), rows_of(ob.matrix_world)
        known = cached.get(ob.session_uid)
        if known is None or known[0] != key:
            known = cached[ob.session_uid] = key, _projected(root, ob, view)
            while len(cached) > _MOST_KEPT:
                del cached[next(iter(cached))]
        found.append(known[1])
    return found


def _is_near(ob: bpy.types.Object, view: View, mouse: tuple[float, float]) -> bool:
    """Whether the object's bounding box is near a pixel. Always so for splats, whose box ends at their centres."""
    if _form_of(ob) == SPLAT:
        return True
    box = view.projected(np.array(ob.bound_box, np.float32), ob.matrix_world)
    if (box[:, 2] <= NEAREST).any():
        return True
    places = box[:, :2] / box[:, 2:3]
    return bool(((places.min(axis=0) - MISS <= mouse) & (places.max(axis=0) + MISS >= mouse)).all())


def _projected(root: bpy.types.Collection, ob: bpy.types.Object, view: View) -> Projected:
    """Project a lift's object into a view, without its hidden parts."""
    data, world = ob.data, ob.matrix_world
    xyz, opacity, form = values_of(data, "position"), None, _form_of(ob)
    ids = np.stack([ids_of(data, "instance_id"), ids_of(data, "class_id")], axis=1)
    shown = ~leaving_out(root.plgs)(*ids.T)
    if ob.type == "POINTCLOUD" and ob.modifiers.get(OPEN_ROOM) is not None:
        to_eye = np.array(world.inverted() @ Vector(view.eye), np.float32)
        shown &= np.einsum("ij,ij->i", values_of(data, "normal"), xyz - to_eye) <= 0.0
    if form == TRIANGLE:
        corners = np.empty(len(data.loops), np.int32)
        data.attributes[".corner_vert"].data.foreach_get("value", corners)
        corners = corners.reshape(-1, 3)[shown[corners[::3]]]  # one corner tells, as all three have the same label
        vertices, ids = view.projected(xyz, world), ids[corners[:, 0]]
    else:
        xyz, ids = xyz[shown], ids[shown]
        if form == POINT:
            radius = world.median_scale * values_of(data, "radius", "value", 1)[shown]
            reach = radius * view.lens[0][0] * view.width / 2.0
            vertices = _with_axes(view.projected(xyz, world), reach * (1.0, 0.0), reach * (0.0, 1.0))
            vertices[: len(xyz), 3:] += radius
        elif form == SQUARE:
            ends = [xyz + values_of(data, axis)[shown] for axis in ("right", "up")]
            vertices = view.projected(np.concatenate([xyz, *ends]), world)
            opacity = values_of(data, "opacity", "value", 1)[shown, 0] if view.is_fading else None
        else:
            turns = values_of(data, "rotation", "value", 4)[shown]
            axes = _axes_of_splats(view, world, xyz, values_of(data, "scale")[shown], turns)
            vertices = _with_axes(view.projected(xyz, world), *axes)
            opacity = values_of(data, "radiance:base", "vector", 4)[shown, 3]
        corners = np.arange(3 * len(xyz), dtype=np.int32).reshape(3, -1).T
    begin, first, second = vertices[corners].transpose(1, 0, 2)
    first, second = first - begin, second - begin
    is_front = np.einsum("ij,ij->i", begin[:, :3], np.cross(first[:, :3], second[:, :3])) > 0.0
    kept = is_front | (not view.are_backs_open) | (form in (POINT, SPLAT))
    extent = {POINT: _COVER, SPLAT: _NATIVE_EXTENT}.get(form, 1.0)
    shares = ((0, 0), (1, 0), (0, 1)) if form == TRIANGLE else ((-1, -1), (-1, 1), (1, -1), (1, 1))
    ends = np.stack([begin + extent * (along * first + aside * second) for along, aside in shares])[..., :3]
    is_before = ends[..., 2] > NEAREST
    with np.errstate(divide="ignore", invalid="ignore"):
        places = ends[..., :2] / ends[..., 2:]
    kept &= is_before.any(axis=0) & np.isfinite(ends).all(axis=(0, 2))
    # Figures that reach behind the eye may be drawn anywhere in the view.
    low, high = (np.where(is_before.all(axis=0)[:, None], each, far) for each, far in
                 ((places.min(axis=0), -np.inf), (places.max(axis=0), np.inf)))  # fmt: skip
    bounds = np.ascontiguousarray(np.concatenate([low, high], axis=1)[kept].T, np.float32)
    return Projected(form, vertices, corners[kept], bounds, ids[kept], None if opacity is None else opacity[kept])


def _form_of(ob: bpy.types.Object) -> str:
    if ob.type == "MESH":
        return SQUARE if "right" in ob.data.attributes else TRIANGLE
    return SPLAT if "radiance:base" in ob.data.attributes else POINT


def _with_axes(middle: NDArray[np.float32], first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float32]:
    """Return vertices [3 N, 4] of elements facing the view, from centres [N, 4] and axes [N, 2] in pixels times W."""
    ends = [np.concatenate([middle[:, :2] + axis, middle[:, 2:]], axis=1) for axis in (first, second)]
    return np.concatenate([middle, *ends]).astype(np.float32)


def _axes_of_splats(
    view: View, world: Matrix, xyz: NDArray[np.float32], deviations: NDArray[np.float32], turns: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the axes, two [N, 2] in pixels times W, whose squares sum to the covariance of Gaussians in the view."""
    axes = axes_of(turns) * deviations[:, :, None]
    middle = view.projected(xyz, world)
    ends = np.stack([view.projected(xyz + axes[:, at], world) for at in range(3)], axis=1) - middle[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = middle[:, :2] / middle[:, 2:3]
    aside = ends[..., :2] - place[:, None] * ends[..., 2:3]  # the derivative of the position in the view, times W
    a, b, c = (np.einsum("nk,nk->n", aside[:, :, i], aside[:, :, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    a = np.sqrt(np.maximum(a, 1e-6))  # Cholesky's factor
    return np.stack([a, b / a], axis=1), np.stack([0.0 * a, np.sqrt(np.maximum(c - (b / a) ** 2, 1e-6))], axis=1)
