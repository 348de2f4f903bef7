"""The lift's Gaussians as Blender's own splats, where the running Blender has them (from 5.3 on).

Blender's PLY importer makes a point cloud of the type GAUSSIAN_SPLAT from any splat file, and its default axes (forward
Y, up Z) are ours. This was read in Blender's source and in its API. It has not been run: there was no Blender 5.3.
"""

from __future__ import annotations

from pathlib import Path

import bpy

from ..engine.errors import PlgsError
from .lift_collection import FOLDER, child_collection
from .owned import LIFT, key_of, tag, text_of

WHY_NOT = "Blender 5.3 or newer has native splats; result/gaussians.ply opens in any splat viewer"
_KEY = "gaussians"


def has_native_splats() -> bool:
    """Whether this Blender knows splats."""
    kind = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kind is not None and "GAUSSIAN_SPLAT" in kind.enum_items


def place_gaussians(root: bpy.types.Collection, scene: bpy.types.Scene) -> bpy.types.Object:
    """Import result/gaussians.ply of a lift into its collection as native splats, in place of earlier ones.

    Raises PlgsError when this Blender has none, when the file is missing, or when it was not read as splats.
    """
    path = Path(bpy.path.abspath(text_of(root, FOLDER))) / "result" / "gaussians.ply"
    if not has_native_splats():
        raise PlgsError("cannot be shown as splats", path, WHY_NOT + ".")
    if not path.is_file():
        raise PlgsError("is not there", path, "Lift the scene again, or load the lift from where it is now.")
    imported = _import(path)
    if imported.type != "POINTCLOUD" or imported.data.type != "GAUSSIAN_SPLAT":
        kind = imported.type.lower()
        _remove(imported)
        raise PlgsError(f"was imported as a {kind}, not as splats", path, "Report it, with the version of Blender.")
    for old in [ob for ob in root.all_objects if key_of(ob, root[LIFT]) == _KEY]:
        _remove(old)
    imported.name = imported.data.name = "Gaussians"
    for collection in imported.users_collection:
        collection.objects.unlink(imported)
    tag(imported, root[LIFT], _KEY)
    tag(imported.data, root[LIFT], _KEY)
    child_collection(root, "Gaussians", scene).objects.link(imported)
    return imported


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
