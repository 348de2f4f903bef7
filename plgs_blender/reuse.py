"""Extract objects of a lift for use elsewhere, each into its own collection, which can be moved and be an asset.

A collection has one object with its origin at the foot of the instance's box: its surface with its semantic points
hidden under it, or only the points if no meshes were made. All of it is the user's: placing a lift never changes it,
and extracting it again keeps its position. The lift's own version of the object is hidden, which leaves a hole."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector
from numpy.typing import NDArray

from ..engine.corrections import read_corrected
from ..engine.errors import PlgsError
from ..engine.result_files import Instance
from .clouds import set_attributes
from .compat import add_keys, new_point_clouds
from .inspecting.lists import registered
from .inspecting.looks import HIDDEN, apply_visibility
from .inspecting.selection import boxes_of, clouds_of, ids_of, is_box, surfaces_of
from .materials import catcher_material, image_of, let_catch, object_colour, surface_material
from .owned import KEY, LIFT, OwnedDataBlocks, folder_of, text_of, untag
from .timeline import places_of

OBJECTS, INSTANCE, PLACED = "plgs_objects_of", "plgs_instance", "plgs_placed"
"""Properties: of the collection of all extracted objects, their lift; of each object's collection, its instance; and of
each object, the pose at which it was placed."""
_COLUMNS = {"FLOAT": ("value", 1), "INT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT_COLOR": ("color", 4)}
_PICTURE = 128  # side of an asset's preview picture in pixels
_DOT = 2  # pixels around a point that its colour fills in the preview


def make_objects(
    root: bpy.types.Collection, numbers: Sequence[int], *, as_assets: bool, catch_shadows: bool = False
) -> list[bpy.types.Collection]:
    """Extract these instances of a placed lift, or extract them again, as collections, and select their objects. With
    ``as_assets`` they become assets with a preview picture; with ``catch_shadows`` they show only the shadows that
    other objects cast on them. Raises PlgsError for an unknown instance."""
    result = read_corrected(folder_of(root))
    known = {one.id: one for one in (*result.instances, *result.removed)}  # removed instances still have meshes
    lost = [number for number in numbers if number not in known]
    if lost:
        ids = ", ".join(map(str, known)) or "none"
        raise PlgsError("no-object", f"has no instance {lost[0]}", root.name, f"Its instances are {ids}.")
    top = _top(root)
    made = [_fill(root, top, known[number]) for number in numbers]
    for collection in made if as_assets else ():
        _mark_as_asset(collection, known[collection[INSTANCE]])
    leave_holes(root)
    surfaces = [ob for collection in made for ob in collection.objects if PLACED in ob]
    for ob in surfaces if catch_shadows else ():
        let_catch(ob, catcher_material(OwnedDataBlocks(root[LIFT], bpy.context.scene), bpy.context.scene))
    _select(surfaces)
    return made


def _select(objects: Sequence[bpy.types.Object]) -> None:
    """Select only these objects, the first one active, if the current scene shows them."""
    layer = bpy.context.view_layer
    layer.update()
    for ob in layer.objects:
        ob.select_set(ob in objects, view_layer=layer)
    layer.objects.active = next((ob for ob in objects if layer.objects.get(ob.name) == ob), layer.objects.active)


def leave_holes(root: bpy.types.Collection) -> None:
    """Hide the lift's own version of each extracted instance."""
    made = {number for number, _ in _made(root)}
    if not made:
        return
    with registered(), apply_visibility.at_once(root):
        for row in root.plgs.instances:
            if row.instance_id in made:
                row.visible = False


def key_visibility(root: bpy.types.Collection, numbers: Sequence[int], scene: bpy.types.Scene) -> int:
    """Key instances to be visible, in views and renders, only in the timeline's frames whose masks show them. Keys go
    to an instance's extracted objects or, without any, to its box (not rendered) and meshes. Returns the number of
    keyed objects. Raises PlgsError at the first instance that no frame shows; those before it are keyed."""
    frame_of = {text_of(ob, "frame") or ob.name: frame for ob, frame in places_of(root, scene).items()}
    showing = {row.instance_id: {mask.frame for mask in row.masks} for row in root.plgs.instances}
    objects = {number: [box] for number, box in boxes_of(root).items()}
    for ob in surfaces_of(root):
        objects.get(ob.get("instance_id"), []).append(ob)
    objects |= {number: [ob for ob in collection.objects if PLACED in ob] for number, collection in _made(root)}
    keyed = 0
    for number in numbers:
        frames = sorted(frame_of[name] for name in frame_of if name in showing.get(number, ()))
        if not frames:
            what = f"no frame shows instance {number}"
            raise PlgsError("never-seen", what, root.name, "Show the result, or choose another instance.")
        every = np.array(sorted(frame_of.values()), float)
        hidden = ~np.isin(every, frames)
        for ob in objects.get(number, ()):
            action = bpy.data.actions.new(f"{ob.name} visibility")
            for path in ("hide_viewport",) if is_box(ob) else ("hide_viewport", "hide_render"):
                add_keys(ob, action, path, frames=every, values=hidden.astype(float), interpolation="CONSTANT")
            keyed += 1
    return keyed


def extracted(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the extracted surfaces of a lift."""
    objects = [ob for _, collection in _made(root) for ob in collection.objects]
    return [ob for ob in objects if PLACED in ob and ob.type == "MESH" and len(ob.data.polygons)]


def _made(root: bpy.types.Collection) -> Iterable[tuple[int, bpy.types.Collection]]:
    """Yield the extracted instances of a lift, with their collections."""
    for top in bpy.data.collections:
        if text_of(top, OBJECTS) == root[LIFT]:
            yield from ((child[INSTANCE], child) for child in top.children if type(child.get(INSTANCE)) is int)


def _top(root: bpy.types.Collection) -> bpy.types.Collection:
    """Return the collection of a lift's extracted objects in the current scene."""
    scene = bpy.context.scene
    for top in scene.collection.children_recursive:
        if text_of(top, OBJECTS) == root[LIFT]:
            return top
    top = bpy.data.collections.new(f"{root.name} objects")
    top[OBJECTS] = root[LIFT]
    scene.collection.children.link(top)
    return top


def _fill(root: bpy.types.Collection, top: bpy.types.Collection, one: Instance) -> bpy.types.Collection:
    # The pivot is the centre of the box's lower face, with the box's axes.
    middle = Matrix.LocRotScale(Vector(one.centre), Quaternion(one.rotation), None)
    placed, pose = middle @ Matrix.Translation((0.0, 0.0, -one.size[2] / 2.0)), None
    inverse, main = placed.inverted(), None
    parts = [("surface", _surface(root, one, inverse)), ("points", _points(root, one, inverse))]
    if not any(data for _, data in parts):
        fix = "Put it back, make its object, and remove it again."
        raise PlgsError("object-removed", f"{one.name} was removed before its surface was made", root.name, fix)
    collection = next((each for number, each in _made(root) if number == one.id and each.name in top.children), None)
    if collection is None:
        collection = bpy.data.collections.new(one.name)
        top.children.link(collection)
    for ob in [*collection.objects]:
        if PLACED in ob and not np.allclose(ob[PLACED], np.ravel(ob.matrix_world), atol=1e-5):
            pose = ob.matrix_world.copy()  # the user moved it
        bpy.data.objects.remove(ob)
    collection.name, collection[INSTANCE] = one.name, one.id
    collection.instance_offset = placed.translation
    for part, data in parts:
        if data is None:
            continue
        ob = bpy.data.objects.new(f"{one.name} {part}", data)
        ob.color, ob["class"], ob["instance_id"] = object_colour(one.colour), one.class_name, one.id
        collection.objects.link(ob)
        if main is None:
            main, ob.matrix_world = ob, pose or placed
            ob[PLACED] = [value for row in placed for value in row]
        else:
            ob.parent, ob.hide_viewport, ob.hide_render = main, True, True
    return collection


def _points(root: bpy.types.Collection, one: Instance, inverse: Matrix) -> bpy.types.PointCloud | None:
    """Return an instance's points, moved by ``inverse`` to its own pivot, with their attributes; None without any."""
    for cloud in clouds_of(root):
        rows = ids_of(cloud.data, "instance_id") == one.id
        if "class_id" not in cloud or not rows.any():
            continue
        turn = np.array(inverse @ cloud.matrix_world)
        xyz = _column(cloud.data, "position", "FLOAT_VECTOR")[rows] @ turn[:3, :3].T + turn[:3, 3]
        (new,) = new_point_clouds([f"{one.name} points"], [xyz.astype(np.float32)])
        for layer in cloud.data.attributes:
            if layer.name in ("position", HIDDEN) or layer.data_type not in _COLUMNS:
                continue
            values = _column(cloud.data, layer.name, layer.data_type)[rows]
            if layer.name == "normal":
                values = values @ turn[:3, :3].T
            set_attributes(new, {layer.name: (layer.data_type, values)})
        for material in cloud.data.materials:
            new.materials.append(material)
        return new
    return None


def _column(data: bpy.types.PointCloud, name: str, kind: str) -> NDArray[Any]:
    field, width = _COLUMNS[kind]
    values = np.empty(len(data.points) * width, np.int32 if kind == "INT" else np.float32)
    data.attributes[name].data.foreach_get(field, values)
    return values.reshape(-1, width) if width > 1 else values


def _surface(root: bpy.types.Collection, one: Instance, inverse: Matrix) -> bpy.types.Mesh | None:
    """Return the instance's mesh, transformed by ``inverse`` to its own pivot; None if no meshes were made."""
    for ob in surfaces_of(root):
        if ob.get("instance_id") == one.id:
            mesh = ob.data.copy()
            untag(mesh)
            mesh.name = f"{one.name} surface"
            image = image_of(mesh.materials[0])
            if image is not None:
                image = image.copy()
                untag(image)
                image.name = mesh.name
                image.pack()  # the lift's file changes when its surface is made again
                image.filepath_raw = f"//{mesh.name}.jpg"
            owned = OwnedDataBlocks(root[LIFT], bpy.context.scene)
            of = ob[KEY] if image is not None else ""
            mesh.materials[0] = surface_material(owned, both_sides=True, image=image, of=of)
            if HIDDEN in mesh.attributes:
                mesh.attributes.remove(mesh.attributes[HIDDEN])
            mesh.transform(inverse @ ob.matrix_world)
            return mesh
    return None


def _mark_as_asset(collection: bpy.types.Collection, one: Instance) -> None:
    collection.asset_mark()
    collection.asset_data.description = f"{one.class_name} of {collection.name}, lifted by PLGS"
    if one.class_name not in {tag.name for tag in collection.asset_data.tags}:
        collection.asset_data.tags.new(one.class_name)
    cloud = next((ob.data for ob in collection.objects if ob.type == "POINTCLOUD"), None)
    if cloud is None or not len(cloud.points):
        return
    rgba = _column(cloud, "Col", "FLOAT_COLOR") if "Col" in cloud.attributes else np.ones((len(cloud.points), 4))
    preview = collection.preview_ensure()
    preview.image_size = (_PICTURE, _PICTURE)
    picture = picture_of_points(_column(cloud, "position", "FLOAT_VECTOR"), rgba[:, :3])
    preview.image_pixels_float.foreach_set(picture.ravel())


def picture_of_points(xyz: NDArray[np.floating], rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """Draw points [N, 3] with linear colours [N, 3], seen from above at the front right. Returns a picture float32 [H,
    W, 4], sRGB, lowest row first, transparent where empty."""
    right, to_eye = np.array([[0.8, 0.6, 0.0], [0.54, -0.72, 0.44]])
    up = np.cross(to_eye, right)
    seen = (xyz - (xyz.min(axis=0) + xyz.max(axis=0)) / 2.0) @ np.stack([right, up, to_eye], axis=1)
    scale = (_PICTURE / 2.0 - _DOT - 1) / max(float(np.abs(seen[:, :2]).max()), 1e-6)
    pixel = np.rint(seen[:, :2] * scale + _PICTURE / 2.0).astype(np.int64)
    order = np.argsort(seen[:, 2], kind="stable")  # the nearest is painted last
    picture = np.zeros((_PICTURE, _PICTURE, 4), np.float32)
    srgb = np.clip(rgb[order], 0.0, 1.0) ** (1.0 / 2.2)  # near enough to sRGB for a preview
    for dy in range(-_DOT, _DOT + 1):
        for dx in range(-_DOT, _DOT + 1):
            column, row = (pixel[order] + (dx, dy)).clip(0, _PICTURE - 1).T
            picture[row, column, :3], picture[row, column, 3] = srgb, 1.0
    return picture
