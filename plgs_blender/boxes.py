"""Oriented boxes, one per instance, drawn as coloured lines and never rendered."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector
from numpy.typing import NDArray

from ..engine.result_files import Instance
from .clouds import set_attributes
from .materials import clear_material, object_colour
from .owned import KEY, OwnedDataBlocks, numbers_of, text_of

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
INSTANCE = "instance:"
"""Prefix of the key of an instance's box; the instance's id follows."""
TOGETHER = "boxes"
"""Key of the object that holds the boxes of all instances without an object of their own."""
MOST_BOXES = 500
"""With 5 000 objects, Blender takes a second to add one, and ten to hide them all."""
NAME, SHOWN, PLACED = "plgs_name", "plgs_shown_name", "plgs_placed"
"""Properties of a box: its instance's name, what Blender made of it, and the centre, size and rotation we gave it. A
mesh has the first two."""
BOX = " box"
"""What follows the instance's name in the name of a box: the name itself is the mesh's."""


def place_boxes(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, instances: Iterable[Instance], *, anew: bool = True
) -> list[bpy.types.Object]:
    """Place one mesh object per instance, with the engine's name and its true size (object scale 1). The box of an
    unchanged instance keeps the user's transform and name, and is not touched at all unless ``anew``. If there are very
    many instances, those with the most points get objects of their own, and one holds all other boxes."""
    own, others = shared_out(instances)
    return [*(_place(owned, parent, one, anew) for one in own), *place_together(owned, parent, others)]


def shared_out(instances: Iterable[Instance]) -> tuple[list[Instance], list[Instance]]:
    """Return the instances that get a box object of their own, and those that share one."""
    given = [*instances]
    most = {one.id for one in sorted(given, key=lambda one: (-one.points, one.id))[:MOST_BOXES]}
    return [one for one in given if one.id in most], [one for one in given if one.id not in most]


def name_object(ob: bpy.types.Object, name: str) -> None:
    """Give a mesh its instance's name, and a box that name followed by BOX."""
    ob[NAME] = name
    ob.name = ob.data.name = f"{name}{BOX}" if text_of(ob, KEY).startswith(INSTANCE) else name
    ob[SHOWN] = ob.name


def _place(owned: OwnedDataBlocks, parent: bpy.types.Collection, instance: Instance, anew: bool) -> bpy.types.Object:
    key, placed = f"{INSTANCE}{instance.id}", [*instance.centre, *instance.size, *instance.rotation]
    before, name, where = owned.known(key), "", None
    if before is not None and numbers_of(before, PLACED) == placed:
        facts = instance.name, instance.class_id, instance.points, instance.views
        listed = tuple(before.get(key) for key in (NAME, "class_id", "points", "views"))
        if not anew and facts == listed and before in owned.in_scene:
            owned.keep(before)
            return before
        where = before.matrix_world.copy()
        name = "" if before.name == text_of(before, SHOWN) else before.name
    mesh = owned.data(key, lambda: bpy.data.meshes.new(instance.name))
    mesh.clear_geometry()
    mesh.from_pydata((_CORNERS * instance.size).tolist(), [], _FACES)
    mesh.update()
    mesh.materials.clear()
    mesh.materials.append(clear_material(owned))
    ob = owned.object(key, name or instance.name, mesh, parent)
    if not name:
        name_object(ob, instance.name)
    ob[NAME], ob[PLACED] = instance.name, placed
    ob.matrix_world = where or Matrix.LocRotScale(Vector(placed[:3]), Quaternion(placed[6:]), None)
    ob.color = object_colour(instance.colour)
    # Only meshes with faces have lines in the object's colour. Views that render show nothing of the clear faces.
    ob.display_type, ob.hide_render = "WIRE", True
    ob.show_name = False  # the labels over the view are readable, Blender's names are not
    ob.show_in_front = True  # it stays visible and selectable through the points that fill it
    ob["class"], ob["class_id"], ob["instance_id"] = instance.class_name, instance.class_id, instance.id
    ob["views"], ob["score"], ob["points"] = instance.views, instance.score, instance.points
    ob["size"], ob["colour"] = list(instance.size), [channel / 255.0 for channel in instance.colour]
    ob.id_properties_ui("score").update(min=0.0, max=1.0, description="Confidence of its masks, 0 to 1")
    ob.id_properties_ui("views").update(min=0, description="Number of frames with a mask of it")
    ob.id_properties_ui("size").update(subtype="XYZ", description="Metres along the box's own axes")
    ob.id_properties_ui("colour").update(subtype="COLOR_GAMMA", min=0.0, max=1.0)
    return ob


def set_faces(mesh: bpy.types.Mesh, xyz: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
    """Give an empty mesh vertices [N, 3] and faces of K corners each, int [F, K]."""
    mesh.vertices.add(len(xyz))
    mesh.vertices.foreach_set("co", xyz.astype(np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, faces.shape[1], dtype=np.int32))


def place_together(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, instances: Sequence[Instance]
) -> list[bpy.types.Object]:
    """Place one object that holds the boxes of all ``instances``; each of its vertices has the instance's id and class
    as attributes. Returns a list of this object; [] without instances."""
    if not instances:
        return []
    mesh = owned.data(TOGETHER, lambda: bpy.data.meshes.new("Other boxes"))
    mesh.clear_geometry()
    turned = np.array([[row[:] for row in Quaternion(one.rotation).to_matrix()] for one in instances])
    corners = (_CORNERS * np.array([one.size for one in instances])[:, None]) @ turned.transpose(0, 2, 1)
    corners += np.array([one.centre for one in instances])[:, None]
    faces = np.arange(len(instances))[:, None, None] * len(_CORNERS) + np.array(_FACES)
    set_faces(mesh, corners.reshape(-1, 3), faces.reshape(-1, 4))
    ids = np.repeat([(one.id, one.class_id) for one in instances], len(_CORNERS), axis=0)
    set_attributes(mesh, {"instance_id": ("INT", ids[:, 0]), "class_id": ("INT", ids[:, 1])})
    mesh.update(calc_edges=True)  # `set_faces` makes none
    mesh.materials.clear()
    mesh.materials.append(clear_material(owned))
    ob = owned.object(TOGETHER, "Other boxes", mesh, parent)
    ob.display_type, ob.hide_render, ob.hide_select = "WIRE", True, True
    return [ob]
