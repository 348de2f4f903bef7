"""Show the lift's Gaussians as splats: Blender's own from 5.3 on, before that one square per Gaussian.

A flat Gaussian's square lies in its plane, another's is its projection onto the surface. Only its front is visible, so
a room lies open from outside. Objects that cameras saw from both sides have a square for each. Material Preview, EEVEE
and Cycles fade squares from the middle and blend overlaps; Solid shading draws them opaque."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.corrections import read_corrected
from ..engine.errors import PlgsError
from ..engine.posed.ply import read_gaussians
from . import splat_objects
from .clouds import SurfaceGrid, towards_nearest
from .inspecting.selection import ids_of
from .owned import (
    FOLDER,
    GAUSSIANS,
    KEY,
    LIFT,
    OwnedDataBlocks,
    Placed,
    child_collection,
    folder_of,
    key_of,
    text_of,
)
from .splat_objects import EXTENT, HARMONIC, Splats, Squares, across, axes_of, joined, place_squares

_FAINTEST, _FAINTEST_NATIVE = 0.1, 0.01
"""Opacity below which a Gaussian gets no square, or no native splat; many faint native splats add up."""
_EDGE_ON = 0.2  # cosine to a square's normal below which a camera counts as seeing neither side
_CAMERAS = 60  # number of cameras, evenly chosen, that are checked for what they see from behind
_FLAT = 0.5  # A Gaussian is flat if its smallest standard deviation is below this fraction of the next one
_LARGEST = 0.2
"""Largest standard deviation of a square in metres: stray Gaussians would hide the room."""
_AT_ONCE = 50_000  # number of Gaussians whose squares are computed without a pause
MOST_SPLATS = 600_000
"""Maximum number of Gaussians shown: if there are more, those that cover most."""


@dataclass(frozen=True, eq=False)
class Eyes:
    """The cameras that saw a lift: ``positions`` float64 [V, 3] metres; ``ahead`` [V, 3], their unit viewing
    directions; ``reach`` [V], the cosine of half the angle of view."""

    positions: NDArray[np.float64]
    ahead: NDArray[np.float64]
    reach: NDArray[np.float64]

    @classmethod
    def of(cls, cameras: Sequence[bpy.types.Object]) -> Eyes:
        turned = np.array([ob.matrix_world for ob in cameras], np.float64).reshape(-1, 4, 4)
        angles = np.array([ob.data.angle for ob in cameras], np.float64)
        return cls(turned[:, :3, 3], -turned[:, :3, 2], np.cos(angles / 2))


def gaussians_of(root: bpy.types.Collection) -> Path:
    """Return the file with the Gaussians of a placed lift, which may not exist."""
    return Path(bpy.path.abspath(text_of(root, FOLDER))) / "result" / "gaussians.ply"


def are_outdated(root: bpy.types.Collection) -> bool:
    """Whether a lift's splats are of a kind that this Blender does not use."""
    return any(
        key_of(ob, root[LIFT]) == GAUSSIANS and (ob.type == "POINTCLOUD") != splat_objects.are_known()
        for ob in root.all_objects
    )


def place_gaussians(root: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    """Put a lift's Gaussians into its collection, replacing earlier ones. Raises PlgsError if it has none."""
    path = gaussians_of(root)
    if not path.is_file():
        raise PlgsError("file-missing", "is not there", path, "Lift the scene again, or open the lift where it is now.")
    for _ in placing_gaussians(root, scene, read_corrected(folder_of(root)).splats(read_gaussians(path))):
        pass


def placing_gaussians(root: bpy.types.Collection, scene: bpy.types.Scene, rows: NDArray[np.void]) -> Iterator[None]:
    """Put Gaussians from `read_gaussians` into a lift's collection, in parts. Stop if it is removed meanwhile."""
    placed = Placed(root[LIFT], scene.name)
    eyes = Eyes.of([ob for ob in root.all_objects if text_of(ob, KEY).startswith("frame:")])
    are_native = splat_objects.are_known()
    clouds = [ob for ob in root.all_objects if text_of(ob, KEY).startswith("class:")]
    surface = SeenSurface.of(clouds, with_objects=not are_native)
    rows, make = rows[seen(rows, _FAINTEST_NATIVE if are_native else _FAINTEST)], splats_of if are_native else squares
    parts = [make(rows[:0], surface, eyes)]  # one even if there are no rows
    for start in range(0, len(rows), _AT_ONCE):
        yield
        parts.append(make(rows[start : start + _AT_ONCE], surface, eyes))
    yield
    found = placed.find()
    if found is None:
        return
    root, scene = found
    owned, parent = OwnedDataBlocks(root[LIFT], scene), child_collection(root, "Gaussians", scene)
    if are_outdated(root):
        owned.drop_object(GAUSSIANS)
    where, whole = (owned, parent, GAUSSIANS, "Gaussians"), joined(parts)
    splats = place_squares(*where, whole) if isinstance(whole, Squares) else splat_objects.place_splats(*where, whole)
    splats.hide_select = True  # a click is meant for the box within


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """The surface that was seen: positions of a lift's semantic points, and their unit normals float32 [N, 3]."""

    grid: SurfaceGrid
    normals: NDArray[np.float32]

    @classmethod
    def of(cls, clouds: Sequence[bpy.types.Object], *, with_objects: bool) -> SeenSurface:
        columns = [np.zeros((2, 0, 3), np.float32)]
        for ob in clouds:
            values = np.empty((2, len(ob.data.points), 3), np.float32)
            for row, name in zip(values, ("position", "normal"), strict=True):
                ob.data.attributes[name].data.foreach_get("vector", row.ravel())
            columns.append(values if with_objects else values[:, ids_of(ob.data, "instance_id") == 0])
        xyz, normals = np.concatenate(columns, axis=1)
        return cls(SurfaceGrid.of(xyz), normals)

    def facing(self, positions: NDArray[np.float32], eyes: Eyes) -> NDArray[np.float32]:
        """Return unit normals float32 [M, 3] for positions [M, 3]: a nearby point's, else the direction to a camera."""
        beside = self.grid.beside(positions)
        normal = np.zeros((len(positions), 3), np.float32)
        normal[beside >= 0] = self.normals[beside[beside >= 0]]
        lost = ~normal.any(axis=1)
        nearest = (
            towards_nearest(positions[lost].astype(np.float64), eyes.positions) if len(eyes.positions) else (0, 0, 1)
        )
        normal[lost] = nearest
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-12))


def seen(rows: NDArray[np.void], faintest: float) -> NDArray[np.int64]:
    """The indices of Gaussians of at least the opacity ``faintest``: at most MOST_SPLATS, those that cover most."""
    opacity, size = _opacity(rows), _size(rows)
    chosen = np.flatnonzero((opacity >= faintest) & np.isfinite(size).all(axis=0))
    if len(chosen) > MOST_SPLATS:
        # The product of all three but the smallest.
        longest = np.sort(size[:, chosen], axis=0)[1:]
        cover = opacity[chosen] * np.minimum(longest, _LARGEST).prod(axis=0)
        chosen = np.sort(chosen[np.argpartition(-cover, MOST_SPLATS)[:MOST_SPLATS]])  # in the file's order
    return chosen


def splats_of(rows: NDArray[np.void], surface: SeenSurface, eyes: Eyes) -> Splats:
    """Return Gaussians [M] as native splats. Those without object get normals, so that walls facing away are hidden."""
    xyz, size, ids = _positions(rows), _size(rows).T, _ids(rows)
    normal = _fronts(_axes(rows), size, surface.facing(xyz, eyes))
    normal[ids["instance_id"] > 0] = 0.0
    turns = np.stack([rows[f"rot_{part}"] for part in range(4)], axis=1)
    turns = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), np.float32(1e-12))
    return Splats(xyz, size, turns, _opacity(rows), _own_srgb(rows), normal, ids)


def squares(rows: NDArray[np.void], surface: SeenSurface, eyes: Eyes) -> Squares:
    """The squares of Gaussians [M], as large as EXTENT standard deviations: flat ones in their plane, others projected
    onto the surface. At the end, objects that cameras see from behind have their squares again, turned around."""
    middle, size = _positions(rows), np.minimum(_size(rows), _LARGEST).T
    axes = _axes(rows)
    first, second = across(_fronts(axes, size, surface.facing(middle, eyes)))
    axes = axes * size[:, :, None]
    along, aside = (np.einsum("mki,mi->mk", axes, each) for each in (first, second))
    a, b, c = (along * along).sum(axis=1), (along * aside).sum(axis=1), (aside * aside).sum(axis=1)
    mean, spread = (a + c) / 2.0, np.hypot((a - c) / 2.0, b)
    turn = np.arctan2(2.0 * b, a - c) / 2.0
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    long, short = (EXTENT * np.sqrt(np.maximum(each, 0.0))[:, None] for each in (mean + spread, mean - spread))
    right, up = (cos * first + sin * second) * long, (cos * second - sin * first) * short
    # The colour around each Gaussian, if the file has it, because squares are nearly opaque.
    has_colours = {"red", "green", "blue"} <= {*(rows.dtype.names or ())}
    rgb = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1) if has_colours else _own_srgb(rows)
    made = Squares(middle, right, up, rgb, _opacity(rows), _ids(rows))
    behind = seen_from_behind(middle, np.cross(right, up), eyes)
    behind = behind[rows["instance_id"][behind] > 0] if "instance_id" in (rows.dtype.names or ()) else behind[:0]
    back = Squares(middle[behind], right[behind], -up[behind], made.rgb[behind], made.opacity[behind],
                   {name: ids[behind] for name, ids in made.ids.items()})  # fmt: skip
    return joined([made, back])


def _fronts(axes: NDArray[np.float32], size: NDArray[np.float32], facing: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return unit normals float32 [M, 3]: a flat Gaussian's own, on the side of `facing` [M, 3]; else `facing`."""
    # Squares turned to the nearest camera show others their back, so a floor of them would have holes.
    own = axes[np.arange(len(axes)), size.argmin(axis=1)]
    own = np.where(np.einsum("ij,ij->i", own, facing)[:, None] < 0.0, -own, own)
    thin, flat, _ = np.sort(size, axis=1).T
    return np.where((thin < _FLAT * flat)[:, None], own, facing)


def seen_from_behind(middle: NDArray[np.float32], normal: NDArray[np.float32], eyes: Eyes) -> NDArray[np.int64]:
    """Return the indices of the positions [M, 3] whose backs, opposite to the normals [M, 3], a camera sees."""
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-12))
    behind, count = np.zeros(len(middle), np.bool_), len(eyes.positions)
    for number in np.linspace(0, count - 1, min(count, _CAMERAS)).astype(np.int64):
        way = middle - eyes.positions[number].astype(np.float32)
        far = np.sqrt(np.einsum("ij,ij->i", way, way))
        is_in_view = way @ eyes.ahead[number].astype(np.float32) > eyes.reach[number] * far
        behind |= is_in_view & (np.einsum("ij,ij->i", way, normal) > _EDGE_ON * far)
    return np.flatnonzero(behind)


def _positions(rows: NDArray[np.void]) -> NDArray[np.float32]:
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)


def _opacity(rows: NDArray[np.void]) -> NDArray[np.float32]:
    return np.asarray(1.0 / (1.0 + np.exp(-rows["opacity"])), np.float32)


def _size(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Return the standard deviations along the three axes, float32 [3, N] in metres."""
    return np.exp(np.stack([rows[f"scale_{axis}"] for axis in range(3)]))


def _axes(rows: NDArray[np.void]) -> NDArray[np.float32]:
    return axes_of(np.stack([rows[f"rot_{part}"] for part in range(4)], axis=1))


def _own_srgb(rows: NDArray[np.void]) -> NDArray[np.uint8]:
    own = 0.5 + HARMONIC * np.stack([rows[f"f_dc_{axis}"] for axis in range(3)], axis=1)
    return np.rint(255.0 * np.clip(own, 0.0, 1.0)).astype(np.uint8)


def _ids(rows: NDArray[np.void]) -> dict[str, NDArray[np.int32]]:
    names = rows.dtype.names or ()
    none = np.zeros(len(rows), np.int32)
    return {name: rows[name].astype(np.int32) if name in names else none for name in ("class_id", "instance_id")}
