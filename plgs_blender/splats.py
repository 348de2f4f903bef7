"""The lift's Gaussians as splats: Blender's own from 5.3 on, and before that one square per Gaussian.

A Gaussian of a lifted surface is flat, so a square across its two longest axes shows it from all sides but its edge.
The squares are one mesh with the attributes Col, opacity and corner (places on the square in standard deviations). The
material fades them from the middle and hides their backs, so a room lies open from outside; what cameras have seen from
both sides has a square for each. EEVEE and Cycles mix what overlaps; Solid shading draws opaque squares.

Blender's PLY importer makes a point cloud of the type GAUSSIAN_SPLAT from any splat file, and its default axes (forward
Y, up Z) are ours. This was read in Blender's source and in its API. It has not been run: there was no Blender 5.3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.errors import PlgsError
from ..engine.posed.splat_file import read_gaussians
from .lift_collection import FOLDER, Placed, child_collection
from .materials import splat_material
from .owned import KEY, LIFT, OwnedDataBlocks, key_of, tag, text_of
from .surfaces import towards_nearest

GAUSSIANS = "gaussians"
"""The key of the object with a lift's splats."""
_FAINTEST = 0.1
"""Opacity below which a Gaussian is left out."""
_EXTENT = 2.0
"""Half the side of a square, in standard deviations."""
_EDGE_ON = 0.2
"""Cosine to a square's normal below which a camera sees it from no side."""
_CAMERAS = 60
"""Cameras, evenly chosen, that are asked what they see from behind."""
_LARGEST = 0.2
"""Largest standard deviation of a square in metres: stray Gaussians would hide the room."""
_AT_ONCE = 50_000
"""Gaussians whose squares are computed while the window waits."""
MOST_SQUARES = 600_000
"""At most this many Gaussians are shown; of more, those that cover most."""
_COLOUR_SCALE = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + this * f_dc."""
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)


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
    rows = rows[seen(rows)]
    parts = [_columns(rows[:0], eyes)]
    for start in range(0, len(rows), _AT_ONCE):
        yield
        parts.append(_columns(rows[start : start + _AT_ONCE], eyes))
    columns = {}
    for name in [*parts[0]]:
        yield
        columns[name] = np.concatenate([part.pop(name) for part in parts])
    yield
    columns |= _sides(len(columns["opacity"]) // 4)
    yield
    found = placed.find()
    if found is None:
        return
    root, scene = found
    owned = OwnedDataBlocks(root[LIFT], scene)
    mesh = _fill(owned, columns)
    splats = owned.object(GAUSSIANS, "Gaussians", mesh, child_collection(root, "Gaussians", scene))
    splats.hide_select = True  # a click is meant for the box within


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


def squares(rows: NDArray[np.void], viewpoints: NDArray[np.floating]) -> NDArray[np.float32]:
    """Corners float32 [M, 4, 3] in metres of the squares of Gaussians [M]. Each faces the nearest of the viewpoints
    [V, 3].
    """
    size = np.minimum(_size(rows), _LARGEST)
    w, x, y, z = np.stack([rows[f"rot_{part}"] for part in range(4)])
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = (part / np.maximum(length, 1e-12) for part in (w, x, y, z))
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ],
        np.float32,
    ).transpose(2, 0, 1)  # [M, axis, xyz]
    order = np.argsort(-_size(rows), axis=0)[:2].T
    own = np.take_along_axis(axes, order[:, :, None], axis=1)
    own *= np.float32(_EXTENT) * np.take_along_axis(size.T, order, axis=1)[:, :, None]
    middle = np.stack([rows[axis] for axis in "xyz"], axis=1)
    if len(viewpoints):
        towards = towards_nearest(middle.astype(np.float64), viewpoints)
        away = np.einsum("ij,ij->i", np.cross(own[:, 0], own[:, 1]), towards) < 0.0
        own[away] = own[away][:, ::-1]
    return (middle[:, None] + np.einsum("ca,maj->mcj", _CORNERS, own)).astype(np.float32)


def seen_from_behind(corners: NDArray[np.float32], eyes: Eyes) -> NDArray[np.int64]:
    """Indices of the squares, float32 [M, 4, 3], whose backs a camera has before it."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    middle, behind = corners.mean(axis=1), np.zeros(len(corners), np.bool_)
    count = len(eyes.places)
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


def _columns(rows: NDArray[np.void], eyes: Eyes) -> dict[str, NDArray[np.generic]]:
    """What the mesh has at the vertices of the squares of Gaussians [M], four each, by attribute."""
    corners = squares(rows, eyes.places)
    both = seen_from_behind(corners, eyes)
    corners, rows = np.concatenate([corners, corners[both, ::-1]]), np.concatenate([rows, rows[both]])
    count, names = len(rows), rows.dtype.names or ()
    if {"red", "green", "blue"} <= {*names}:  # what is around: the squares are opaque, or nearly so
        srgb = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1) / np.float32(255)
    else:
        srgb = np.clip(0.5 + _COLOUR_SCALE * np.stack([rows[f"f_dc_{axis}"] for axis in range(3)], axis=1), 0, 1)
    rgba = np.ones((count, 4), np.float32)
    rgba[:, :3] = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    corner = np.zeros((count, 4, 3), np.float32)
    corner[..., :2] = _EXTENT * _CORNERS
    columns = {"position": corners, "corner": corner, "Col": np.repeat(rgba, 4, axis=0)}
    columns["opacity"] = np.repeat(_opacity(rows), 4)
    for name in ("class_id", "instance_id"):
        ids = rows[name] if name in names else np.zeros(count, np.int32)
        columns[name] = np.repeat(ids.astype(np.int32), 4)
    return {name: values.ravel() for name, values in columns.items()}


def _sides(count: int) -> dict[str, NDArray[np.generic]]:
    """The sides of the squares: attributes that Blender's meshes have of themselves."""
    numbers = np.arange(4 * count, dtype=np.int32)
    ends = np.stack([numbers, numbers + np.tile(np.array([1, 1, 1, -3], np.int32), count)], axis=1)
    return {".corner_vert": numbers, ".corner_edge": numbers, ".edge_verts": ends.ravel()}


def _fill(owned: OwnedDataBlocks, columns: Mapping[str, NDArray[np.generic]]) -> bpy.types.Mesh:
    """Our mesh of squares with these attributes."""
    count = len(columns["opacity"]) // 4
    mesh: bpy.types.Mesh = owned.data(GAUSSIANS, lambda: bpy.data.meshes.new("Gaussians"))
    mesh.clear_geometry()
    mesh.vertices.add(4 * count)
    mesh.loops.add(4 * count)
    mesh.edges.add(4 * count)
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 4 * count, 4, dtype=np.int32))
    mesh.color_attributes.new("Col", "FLOAT_COLOR", "POINT")
    for name, kind in (("corner", "FLOAT_VECTOR"), ("opacity", "FLOAT"), ("class_id", "INT"), ("instance_id", "INT")):
        mesh.attributes.new(name, kind, "POINT")
    # Attributes are copied at once. What `vertices` and `loops` call co and vertex_index would be set one by one.
    for name, values in columns.items():
        field = {"position": "vector", "corner": "vector", "Col": "color"}.get(name, "value")
        mesh.attributes[name].data.foreach_set(field, values)
    mesh.color_attributes.active_color = mesh.color_attributes["Col"]
    mesh.materials.clear()
    mesh.materials.append(splat_material(owned))
    mesh.update()
    return mesh


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
