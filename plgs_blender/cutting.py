"""The plane that cuts an object in two: placed through it, dragged by the user, and taken away after the cut."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..engine.corrections import Edit
from ..engine.errors import PlgsError
from .corrections import split_plane
from .inspecting.lookup import box_of, objects_by_key
from .inspecting.selection import deselect_all
from .owned import LIFT, OwnedDataBlocks
from .viewport import show_gizmos

CUT = "cut"
"""Key of the plane that splits an object."""
_GIZMOS = "plgs_gizmos"
"""Property of the plane: whether the views show the arrows that move it only because of it."""
_LARGER = 1.2
"""How many times larger than the object the plane is."""


def place_cut(root: bpy.types.Collection, instance: int) -> bpy.types.Object:
    """Put an upright plane through the middle of an object's box, across its longest side, for the user to drag. Raises
    PlgsError."""
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
    """Split an object by the plane that `place_cut` placed, which is then taken away. Raises PlgsError."""
    plane = objects_by_key(root).get(CUT)
    if plane is None:
        raise PlgsError("there is no cutting plane", root.name, "Press Add Plane below Correct, then drag the plane.")
    normal = (plane.matrix_world.to_3x3() @ Vector((0.0, 0.0, 1.0))).normalized()
    made = split_plane(root, instance, plane.matrix_world.translation[:], normal[:])
    if plane.get(_GIZMOS):
        show_gizmos(bpy.context.scene, False)
    bpy.data.objects.remove(objects_by_key(root)[CUT])
    return made
