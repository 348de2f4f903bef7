"""Tools that correct an object: a cutting plane, painted points, and edits by an engine (splits by views, removals)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from ..engine.corrections import Edit, read_corrected, read_edits
from ..engine.errors import PlgsError
from ..engine.job.follower import TaskFollower
from . import corrections, engine_environment, registry
from .corrections import split_plane
from .errors import plural
from .inspecting.drawing import draw_mark, draw_outline
from .inspecting.highlight import Highlight, mark_of
from .inspecting.selection import CUT, box_of, deselect_all, objects_by_key
from .owned import FOLDER, LIFT, OwnedDataBlocks, folder_of, is_same_place, lifts_in, text_of
from .registry import Task, start_engine
from .viewport import show_gizmos

_GIZMOS = "plgs_gizmos"
"""Property of the plane: whether its move arrows were switched on in the views only for it."""
_LARGER = 1.2  # size of the plane relative to the object


def place_cut(root: bpy.types.Collection, instance: int) -> bpy.types.Object:
    """Put an upright plane through the middle of an object's box, across its longest side, and return it. Raises
    PlgsError if the box is gone."""
    box = box_of(root, instance)
    owned = OwnedDataBlocks(root[LIFT], bpy.context.scene)
    mesh = owned.data(CUT, lambda: bpy.data.meshes.new("Cut"))
    size = [side * _LARGER / 2.0 for side in box["size"]]
    axis = int(np.argmax(size[:2]))
    across, up = size[1 - axis], size[2]
    mesh.clear_geometry()
    mesh.from_pydata([(-across, -up, 0), (across, -up, 0), (across, up, 0), (-across, up, 0)], [], [(0, 1, 2, 3)])
    plane = owned.object(CUT, "Cut", mesh, root)
    normal, upward = Vector((1.0 - axis, float(axis), 0.0)), Vector((0.0, 0.0, 1.0))
    axes = Matrix((upward.cross(normal), upward, normal)).transposed().to_4x4()
    turned = box.matrix_world.to_3x3().normalized().to_4x4()
    plane.matrix_world = Matrix.Translation(box.matrix_world.translation) @ turned @ axes
    plane.display_type, plane.hide_render = "WIRE", True
    plane.show_in_front = True
    deselect_all(bpy.context.view_layer)
    plane.select_set(True)
    bpy.context.view_layer.objects.active = plane
    plane[_GIZMOS] = show_gizmos(bpy.context.scene, True)
    return plane


def split_by_cut(root: bpy.types.Collection, instance: int) -> Edit:
    """Split an object by the plane of `place_cut` and remove the plane. Raises PlgsError without such a plane."""
    plane = objects_by_key(root).get(CUT)
    if plane is None:
        what = "there is no cutting plane"
        raise PlgsError("no-plane", what, root.name, "Press Add Plane below Correct, then drag the plane.")
    normal = (plane.matrix_world.to_3x3() @ Vector((0.0, 0.0, 1.0))).normalized()
    made = split_plane(root, instance, plane.matrix_world.translation[:], normal[:])
    if plane.get(_GIZMOS):
        show_gizmos(bpy.context.scene, False)
    bpy.data.objects.remove(objects_by_key(root)[CUT])
    return made


_CELL = 8
"""Pixels: in each square of this side, the nearest point hides those behind it."""
_BEHIND = 0.15  # metres that a point may lie behind the nearest one and still be painted
_RADIUS = 24.0  # the brush's initial radius in pixels
_COLOUR = (1.0, 0.55, 0.1)
_POINT, _TINT = 0.01, 0.4  # drawing radius of a painted point in metres, and the opacity of its colour

Position = tuple[float, float]
"""Of the mouse, in pixels of the view, y up."""


@dataclass(eq=False)
class Painting:
    """The state of painting points, which ends with Enter. ``xyz`` float32 [N, 3] are the lift's points, ``chosen``
    bool [N] the painted ones; ``radius``: the brush's, in pixels. ``drag`` holds the mouse's positions since its button
    was pressed; ``mouse`` is the current one. ``is_box``: a drag is a rectangle; ``is_eraser``: drags remove points."""

    xyz: NDArray[np.float32]
    chosen: NDArray[np.bool_]
    radius: float = _RADIUS
    drag: list[Position] = field(default_factory=list)
    mouse: Position = (0.0, 0.0)
    is_box: bool = False
    is_eraser: bool = False
    _shown: Highlight | None = None

    @classmethod
    def of(cls, xyz: NDArray[np.float32]) -> Painting:
        """Return a painting of points [N, 3] in which none is chosen yet."""
        return cls(xyz, np.zeros(len(xyz), bool))

    @classmethod
    def of_lift(cls, folder: Path) -> Painting:
        """Return a painting of a lift's points, none of them chosen yet. Raises PlgsError if they are unreadable."""
        return cls.of(read_corrected(folder).points.xyz)

    def press(self, position: Position, *, is_box: bool, is_eraser: bool) -> None:
        self.drag, self.is_box, self.is_eraser = [position], is_box, is_eraser

    def move(self, position: Position) -> None:
        """Follow the mouse; while its button is down, extend the stroke."""
        self.mouse = position
        if self.drag:
            self.drag.append(position)

    def release(self, to_view: NDArray[np.float64], size: tuple[int, int]) -> None:
        """End the drag and find its points at once, so the view may be turned before the next one. ``to_view`` and
        ``size`` are as in `visible`."""
        if self.drag:
            pick = boxed if self.is_box else painted
            self.chosen[pick(self.xyz, to_view, size, self.drag, self.radius)] = not self.is_eraser
            self.drag, self._shown = [], None

    def choose(self, xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which of a result's points [N, 3] were painted, bool [N]. Raises PlgsError if the points have changed."""
        if xyz.shape != self.xyz.shape:
            what = "the lift's points have changed"
            raise PlgsError("points-changed", what, "Paint Points", "Show its result again, then paint.")
        return self.chosen

    def draw(self, view: bpy.types.RegionView3D, size: tuple[int, int]) -> None:
        """Draw, in pixels, the painted points and the brush or the dragged rectangle."""
        if self._shown is None:
            self._shown = Highlight(("painted", self.chosen.tobytes()), self.xyz[self.chosen], _POINT)
        draw_mark(mark_of(self._shown, view, size, _COLOUR, _TINT))
        x, y = self.mouse
        if self.is_box and self.drag:
            left, low = self.drag[0]
            draw_outline([(left, low), (x, low), (x, y), (left, y)], _COLOUR)
        else:
            turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
            circle = np.array(self.mouse) + self.radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            draw_outline([(float(u), float(v)) for u, v in circle], _COLOUR)


now: list[Painting] = []
"""The current painting, for the overlay; at most one."""


def visible(
    xyz: NDArray[np.float32], to_view: NDArray[np.float64], size: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the points of [N, 3] that nothing hides in a view: their indices int64 [n] and pixels float64 [n, 2], y
    up. ``to_view`` [4, 4] is the view's perspective matrix, ``size`` its width and height in pixels."""
    seen = np.c_[xyz, np.ones(len(xyz))] @ to_view.T
    depth = seen[:, 3]
    pixel = (seen[:, :2] / np.where(depth > 1e-6, depth, np.inf)[:, None] * 0.5 + 0.5) * np.array(size)
    inside = (depth > 1e-6) & (pixel >= 0).all(axis=1) & (pixel < np.array(size)).all(axis=1)
    rows = np.flatnonzero(inside)
    cell = (pixel[rows] // _CELL).astype(np.int64) @ np.array([1, size[0] // _CELL + 1])
    nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)  # no point may be in the view
    np.minimum.at(nearest, cell, depth[rows])  # not an assignment, as many points share a cell
    rows = rows[depth[rows] <= nearest[cell] + _BEHIND]
    return rows, pixel[rows]


def painted(
    xyz: NDArray[np.float32],
    to_view: NDArray[np.float64],
    size: tuple[int, int],
    stroke: Sequence[Position],
    radius: float,
) -> NDArray[np.int64]:
    """Return the indices, int64 [n], of `visible` points within ``radius`` pixels of a ``stroke`` of the brush."""
    rows, pixel = visible(xyz, to_view, size)
    under = np.zeros(len(rows), bool)
    for position in stroke:
        under |= ((pixel - np.array(position)) ** 2).sum(axis=1) <= radius**2
    return rows[under]


def boxed(
    xyz: NDArray[np.float32],
    to_view: NDArray[np.float64],
    size: tuple[int, int],
    drag: Sequence[Position],
    _: float = 0.0,
) -> NDArray[np.int64]:
    """Return the indices, int64 [n], of the `visible` points in the rectangle between a drag's ends."""
    rows, pixel = visible(xyz, to_view, size)
    low, high = np.sort([drag[0], drag[-1]], axis=0)
    return rows[((pixel >= low) & (pixel <= high)).all(axis=1)]


class EditByEngine(Task):
    """An edit of a placed lift that needs the photos or the masks. The engine writes the edit to the lift's file; then
    Blender shows it. ``step`` names its undo step."""

    edit_kind, step = "", ""

    def __init__(self, lift: Path, follower: TaskFollower, known: Collection[str]) -> None:
        """Follow an edit that the engine makes. ``known`` are the uids of the edits that existed before."""
        super().__init__(follower)
        self._lift, self._known = lift, known
        self._edit: Edit | None = None

    @property
    def has_finished(self) -> bool:
        """Whether the edit was made; true also if an engine was stopped after writing it but before answering."""
        return self._edit is not None

    @property
    def was_cancelled(self) -> bool:
        return super().was_cancelled and not self.has_finished

    def done(self, scene: Any) -> None:
        made = [edit for edit in read_edits(self._lift) if edit.uid not in self._known and edit.kind == self.edit_kind]
        self._edit = made[-1] if made else None
        every = {root for each in bpy.data.scenes for root in lifts_in(each)}  # a set, as scenes may share a collection
        shown = [root for root in every if is_same_place(text_of(root, FOLDER), self._lift)]
        if self._edit is None or not shown:
            return
        result = read_corrected(self._lift)
        for root in shown:
            corrections.show_edit(root, self._edit.uid, result)
        self.undo_step = self.step

    @classmethod
    def start(cls, root: bpy.types.Collection, *edit: str) -> Self:
        """Let an engine run ``correct`` with the arguments ``edit``. Raises PlgsError if no engine can; OSError."""
        registry.refuse_second(cls)
        lift, python = folder_of(root), engine_environment.usable_python()
        known = {each.uid for each in read_edits(lift)}
        return registry.begin(cls(lift, start_engine("correct", python, lift, *edit), known))


class SplitByViews(EditByEngine):
    """A task that splits one object by the masks."""

    kind, label, cancel_operator = "split", "Reading the masks", "plgs.cancel_split"
    edit_kind, step = "split", "Split by Views"

    @property
    def message(self) -> str:
        """One line for the user about the resulting objects."""
        if self.was_cancelled:
            return "The split was cancelled"
        return plural(0 if self._edit is None else len(self._edit.made), "new object")


class RemoveObjects(EditByEngine):
    """A task that takes objects out of the room, and fills what was behind them."""

    kind, label, cancel_operator = "remove", "Removing objects", "plgs.cancel_removal"
    edit_kind, step = "remove", "Remove Objects"

    @property
    def message(self) -> str:
        """One line for the user about the removed objects."""
        if self.was_cancelled:
            return "The removal was cancelled"
        removed = f"{plural(0 if self._edit is None else len(self._edit.objects), 'object')} removed"
        return "; ".join([removed, *self.follower.progress.warnings])


def split_by_views(root: bpy.types.Collection, instance: int) -> SplitByViews:
    """Start splitting an object into the parts that masks separate. Raises PlgsError without an engine."""
    return SplitByViews.start(root, "split", str(instance), "--views")


def remove_objects(root: bpy.types.Collection, instances: Sequence[int]) -> RemoveObjects:
    """Start taking objects out of a placed lift. Raises PlgsError without an engine; OSError."""
    return RemoveObjects.start(root, "remove", *map(str, instances))
