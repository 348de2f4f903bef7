"""The lift's Gaussians as splats: Blender's own from 5.3 on, and before that one square per Gaussian.

A square lies as its Gaussian does where that is flat, else it is the shadow on its surface. It shows its front alone,
so a room lies open from outside. Objects that cameras have seen from both sides have a square for each. Material
Preview, EEVEE and Cycles fade squares from the middle and mix what overlaps; Solid shading draws them opaque.

Blender's PLY importer makes a point cloud of the type GAUSSIAN_SPLAT from any splat file, and its default axes (forward
Y, up Z) are ours. This was read in Blender's source and in its API. It has not been run: there was no Blender 5.3.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.errors import PlgsError
from ..engine.posed.splat_file import read_gaussians
from .lift_collection import FOLDER, Placed, child_collection
from .owned import KEY, LIFT, OwnedDataBlocks, key_of, tag, text_of
from .squares import EXTENT, Squares, across, place_squares
from .surfaces import SurfaceGrid, towards_nearest

GAUSSIANS = "gaussians"
"""The key of the object with a lift's splats."""
_FAINTEST = 0.1
"""Opacity below which a Gaussian is left out."""
_EDGE_ON = 0.2
"""Cosine to a square's normal below which a camera sees it from no side."""
_CAMERAS = 60
"""Cameras, evenly chosen, that are asked what they see from behind."""
_FLAT = 0.5
"""Smallest standard deviation over the next one below which a Gaussian itself says how it lies."""
_LARGEST = 0.2
"""Largest standard deviation of a square in metres: stray Gaussians would hide the room."""
_AT_ONCE = 50_000
"""Gaussians whose squares are computed while the window waits."""
MOST_SQUARES = 600_000
"""At most this many Gaussians are shown; of more, those that cover most."""
_COLOUR_SCALE = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + this * f_dc."""


@dataclass(frozen=True, eq=False)
class Eyes:
    """Where cameras [V] are: ``places`` float64 [V, 3] metres; ``ahead`` [V, 3], the unit vectors of where they look;
    ``reach`` [V], the cosine of the angle to the picture's nearer edge."""

    places: NDArray[np.float64]
    ahead: NDArray[np.float64]
    reach: NDArray[np.float64]

    @classmethod
    def of(cls, cameras: Sequence[bpy.types.Object]) -> Eyes:
        turned = np.array([ob.matrix_world for ob in cameras], np.float64).reshape(-1, 4, 4)
        angles = np.array([ob.data.angle for ob in cameras], np.float64)
        return cls(turned[:, :3, 3], -turned[:, :3, 2], np.cos(angles / 2))


def has_native_splats() -> bool:
    """Whether this Blender knows splats."""
    kind = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kind is not None and "GAUSSIAN_SPLAT" in kind.enum_items


def gaussians_of(root: bpy.types.Collection) -> Path:
    """The file with the Gaussians of a placed lift, which need not be there."""
    return Path(bpy.path.abspath(text_of(root, FOLDER))) / "result" / "gaussians.ply"


def place_gaussians(root: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    """Put the Gaussians of a lift into its collection as splats, in place of earlier ones.

    Raises PlgsError when the file is missing, when it holds no splats, or when Blender did not read it as splats.
    """
    path = gaussians_of(root)
    if not path.is_file():
        raise PlgsError("is not there", path, "Lift the scene again, or load the lift from where it is now.")
    if has_native_splats():
        _place_native(root, scene, path)
        return
    for _ in placing_gaussians(root, scene, read_gaussians(path)):
        pass


def placing_gaussians(
    root: bpy.types.Collection, scene: bpy.types.Scene, rows: NDArray[np.void]
) -> Iterator[None]:
    """Put Gaussians, as `read_gaussians` has them, into a lift's collection in parts, for a window that must not wait.
    It ends early when the collection is removed between two.
    """
    placed = Placed(root[LIFT], scene.name)
    eyes = Eyes.of([ob for ob in root.all_objects if text_of(ob, KEY).startswith("frame:")])
    surface = SeenSurface.of([ob for ob in root.all_objects if text_of(ob, KEY).startswith("class:")])
    rows = rows[seen(rows)]
    parts = [squares(rows[:0], surface, eyes)]
    for start in range(0, len(rows), _AT_ONCE):
        yield
        parts.append(squares(rows[start : start + _AT_ONCE], surface, eyes))
    yield
    found = placed.find()
    if found is None:
        return
    root, scene = found
    parent = child_collection(root, "Gaussians", scene)
    splats = place_squares(OwnedDataBlocks(root[LIFT], scene), parent, GAUSSIANS, "Gaussians", Squares.joined(parts))
    splats.hide_select = True  # a click is meant for the box within


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Where a lift's semantic points are, and their unit normals float32 [N, 3]."""

    grid: SurfaceGrid
    normals: NDArray[np.float32]

    @classmethod
    def of(cls, clouds: Sequence[bpy.types.Object]) -> SeenSurface:
        columns = [np.zeros((2, 0), np.float32)]
        for ob in clouds:
            values = np.empty((2, 3 * len(ob.data.points)), np.float32)
            for row, name in zip(values, ("position", "normal"), strict=True):
                ob.data.attributes[name].data.foreach_get("vector", row)
            columns.append(values)
        xyz, normals = np.concatenate(columns, axis=1).reshape(2, -1, 3)
        return cls(SurfaceGrid.of(xyz), normals)

    def facing(self, places: NDArray[np.float32], eyes: Eyes) -> NDArray[np.float32]:
        """Unit normals float32 [M, 3] at these places [M, 3]: that of a point beside each, else towards an eye."""
        beside = self.grid.beside(places)
        normal = np.zeros((len(places), 3), np.float32)
        normal[beside >= 0] = self.normals[beside[beside >= 0]]
        lost = ~normal.any(axis=1)
        normal[lost] = towards_nearest(places[lost].astype(np.float64), eyes.places) if len(eyes.places) else (0, 0, 1)
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-12))


def _place_native(root: bpy.types.Collection, scene: bpy.types.Scene, path: Path) -> None:
    """The file as Blender's own splats. Raises PlgsError."""
    parent = child_collection(root, "Gaussians", scene)
    imported = _import(path)
    if imported.type != "POINTCLOUD" or imported.data.type != "GAUSSIAN_SPLAT":
        kind = imported.type.lower()
        _remove(imported)
        raise PlgsError(f"was imported as a {kind}, not as splats", path, "Report it, with the version of Blender.")
    for old in [ob for ob in root.all_objects if key_of(ob, root[LIFT]) == GAUSSIANS]:
        _remove(old)
    imported.name = imported.data.name = "Gaussians"
    for collection in imported.users_collection:
        collection.objects.unlink(imported)
    tag(imported, root[LIFT], GAUSSIANS)
    tag(imported.data, root[LIFT], GAUSSIANS)
    parent.objects.link(imported)
    imported.hide_select = True


def seen(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """Indices of the Gaussians that can be seen: at most MOST_SQUARES that cover most."""
    opacity, size = _opacity(rows), _size(rows)
    chosen = np.flatnonzero((opacity >= _FAINTEST) & np.isfinite(size).all(axis=0))
    if len(chosen) > MOST_SQUARES:
        # The product of all three but the smallest.
        longest = np.sort(size[:, chosen], axis=0)[1:]
        cover = opacity[chosen] * np.minimum(longest, _LARGEST).prod(axis=0)
        chosen = np.sort(chosen[np.argpartition(-cover, MOST_SQUARES)[:MOST_SQUARES]])
    return chosen


def squares(rows: NDArray[np.void], surface: SeenSurface, eyes: Eyes) -> Squares:
    """The squares of Gaussians [M], as large as EXTENT standard deviations: flat ones as they lie, others as shadows on
    the surface. Those of objects that cameras see from behind follow, turned around.
    """
    middle = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)
    axes, size = _axes(rows), np.minimum(_size(rows), _LARGEST).T
    thin, flat, _ = np.sort(size, axis=1).T
    facing, own = surface.facing(middle, eyes), axes[np.arange(len(axes)), size.argmin(axis=1)]
    own = np.where(np.einsum("ij,ij->i", own, facing)[:, None] < 0.0, -own, own)
    # What is turned to the nearest eye shows others its back: a floor of such squares has holes.
    first, second = across(np.where((thin < _FLAT * flat)[:, None], own, facing))
    axes = axes * size[:, :, None]
    along, aside = (np.einsum("mki,mi->mk", axes, each) for each in (first, second))
    a, b, c = (along * along).sum(axis=1), (along * aside).sum(axis=1), (aside * aside).sum(axis=1)
    mean, spread = (a + c) / 2.0, np.hypot((a - c) / 2.0, b)
    turn = np.arctan2(2.0 * b, a - c) / 2.0
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    long, short = (EXTENT * np.sqrt(np.maximum(each, 0.0))[:, None] for each in (mean + spread, mean - spread))
    right, up = (cos * first + sin * second) * long, (cos * second - sin * first) * short
    made = Squares(middle, right, up, _srgb(rows), _opacity(rows), _ids(rows))
    behind = seen_from_behind(middle, np.cross(right, up), eyes)
    behind = behind[rows["instance_id"][behind] > 0] if "instance_id" in (rows.dtype.names or ()) else behind[:0]
    back = Squares(middle[behind], right[behind], -up[behind], made.rgb[behind], made.opacity[behind],
                   {name: ids[behind] for name, ids in made.ids.items()})  # fmt: skip
    return Squares.joined([made, back])


def seen_from_behind(
    middle: NDArray[np.float32], normal: NDArray[np.float32], eyes: Eyes
) -> NDArray[np.int64]:
    """Indices of the places [M, 3] whose backs, opposite to the normals [M, 3], a camera has before it."""
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-12))
    behind, count = np.zeros(len(middle), np.bool_), len(eyes.places)
    for number in np.linspace(0, count - 1, min(count, _CAMERAS)).astype(np.int64):
        way = middle - eyes.places[number].astype(np.float32)
        far = np.sqrt(np.einsum("ij,ij->i", way, way))
        is_in_view = way @ eyes.ahead[number].astype(np.float32) > eyes.reach[number] * far
        behind |= is_in_view & (np.einsum("ij,ij->i", way, normal) > _EDGE_ON * far)
    return np.flatnonzero(behind)


def _opacity(rows: NDArray[np.void]) -> NDArray[np.float32]:
    return np.asarray(1.0 / (1.0 + np.exp(-rows["opacity"])), np.float32)


def _size(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Standard deviations along the three axes, float32 [3, N] in metres."""
    return np.exp(np.stack([rows[f"scale_{axis}"] for axis in range(3)]))


def _axes(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """The unit axes of Gaussians [M], float32 [M, axis, xyz]."""
    w, x, y, z = np.stack([rows[f"rot_{part}"] for part in range(4)])
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = (part / np.maximum(length, 1e-12) for part in (w, x, y, z))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ],
        np.float32,
    ).transpose(2, 0, 1)


def _srgb(rows: NDArray[np.void]) -> NDArray[np.uint8]:
    """The colour around each Gaussian [M, 3] if the file has it, as squares are nearly opaque; else its own."""
    if {"red", "green", "blue"} <= {*(rows.dtype.names or ())}:
        return np.stack([rows[name] for name in ("red", "green", "blue")], axis=1)
    own = 0.5 + _COLOUR_SCALE * np.stack([rows[f"f_dc_{axis}"] for axis in range(3)], axis=1)
    return np.rint(255.0 * np.clip(own, 0.0, 1.0)).astype(np.uint8)


def _ids(rows: NDArray[np.void]) -> dict[str, NDArray[np.int32]]:
    names = rows.dtype.names or ()
    none = np.zeros(len(rows), np.int32)
    return {name: rows[name].astype(np.int32) if name in names else none for name in ("class_id", "instance_id")}


def _import(path: Path) -> bpy.types.Object:
    """Import the file and return the new object. Raises PlgsError when there is not exactly one."""
    before = set(bpy.data.objects)
    try:
        bpy.ops.wm.ply_import(filepath=str(path))
    except RuntimeError as error:
        raise PlgsError(f"cannot be imported ({str(error).strip()})", path, "Lift the scene again.") from error
    added = [ob for ob in bpy.data.objects if ob not in before]
    if len(added) != 1:
        raise PlgsError(f"was imported as {len(added)} objects", path, "Report it, with the version of Blender.")
    return added[0]


def _remove(ob: bpy.types.Object) -> None:
    """Remove an object, and its data unless somebody else uses them."""
    data = ob.data
    bpy.data.objects.remove(ob)
    if data is not None and data.users == 0:
        bpy.data.batch_remove([data])
