"""Finding a lift and what belongs to it, by our custom properties."""

from __future__ import annotations

from itertools import chain
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import PlgsError
from ..boxes import INSTANCE, MOST_BOXES, TOGETHER
from ..lift_collection import FOLDER, GAUSSIANS, is_same_place, lifts_in
from ..owned import KEY, LIFT, originals, text_of
from ..paths import absolute


def find_lift(scene: bpy.types.Scene, lift: str = "", active: bpy.types.Object | None = None) -> bpy.types.Collection:
    """The collection of the lift that `lift` names, by its folder or its collection's name. When `lift` is empty, as
    `active_lift`. Raises PlgsError when there is none.
    """
    roots = lifts_in(scene)
    if lift:
        named = [root for root in roots if lift == root.name or is_same_place(text_of(root, FOLDER), absolute(lift))]
        if not named:
            raise PlgsError("is not in this scene", lift, "Name a lift's folder or its collection.")
        return named[0]
    found = active_lift(scene, active)
    if found is None:
        raise PlgsError("has no lift in it", scene.name, "Lift a scene, or open a finished lift.")
    return found


def active_lift(scene: bpy.types.Scene, active: bpy.types.Object | None) -> bpy.types.Collection | None:
    """The lift that an object belongs to, else the scene's first with a result, else the scene's first, else None."""
    roots = lifts_in(scene)
    own = None if active is None else text_of(active, LIFT)
    of_object = [root for root in roots if root[LIFT] == own]
    with_result = [root for root in roots if len(root.plgs.classes)]
    return next(iter((*of_object, *with_result, *roots)), None)


def chosen_row(scene: bpy.types.Scene, active: bpy.types.Object | None) -> Any | None:
    """The active row in the list of the lift that the panels show; None when no row is active."""
    root = active_lift(scene, active)
    if root is None or not 0 <= root.plgs.instance_index < len(root.plgs.instances):
        return None
    return root.plgs.instances[root.plgs.instance_index]


def objects_by_key(root: bpy.types.Collection) -> dict[str, bpy.types.Object]:
    """The lift's objects by their keys: "instance:3", "class:1", "frame:0012", "anchors". Objects that the user moved
    to another collection of the scene are among them.
    """
    scenes = [scene for scene in bpy.data.scenes if root in scene.collection.children_recursive]
    return originals(chain(root.all_objects, *(scene.objects for scene in scenes)), root[LIFT])


def boxes_of(root: bpy.types.Collection) -> dict[int, bpy.types.Object]:
    """The boxes by the id of their instance. Boxes that the user deleted are missing."""
    return {instance_of(ob): ob for ob in objects_by_key(root).values() if is_box(ob)}


def box_of(root: bpy.types.Collection, instance: int) -> bpy.types.Object:
    """The box of an instance (0: the list's active one). Raises PlgsError where it has none."""
    row, objects = row_of(root, instance), objects_by_key(root)
    box = objects.get(f"{INSTANCE}{row.instance_id}")
    if box is None and TOGETHER in objects:
        fix = f"Choose one of the {MOST_BOXES} objects with the most points."
        raise PlgsError("has no box of its own, as there are so many objects", row.name, fix)
    if box is None:
        raise PlgsError("has no box any more", row.name, "Show the lift's result again.")
    return box


def is_box(ob: bpy.types.Object | None) -> bool:
    """Whether an object is the box of some lift's instance."""
    return ob is not None and text_of(ob, KEY).startswith(INSTANCE) and instance_of(ob) > 0


def instance_of(ob: bpy.types.Object | None) -> int:
    """The id of the instance whose box or mesh an object is; 0 for any other object."""
    if ob is None or not text_of(ob, LIFT):
        return 0
    kind, _, number = text_of(ob, KEY).partition(":")
    number = number.rpartition(":")[2] if kind == "mesh" else number
    return int(number) if kind in ("instance", "mesh") and number.isdecimal() else 0


def clouds_of(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """The semantic points, one object per class, and the anchors."""
    return [ob for key, ob in objects_by_key(root).items() if ob.type == "POINTCLOUD" and key != GAUSSIANS]


def surfaces_of(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """The splats and the meshes of the lift: those that have a class at each vertex."""
    of_kind = {key: ob for key, ob in objects_by_key(root).items() if ob.type == "MESH" or key == GAUSSIANS}
    return [ob for ob in of_kind.values() if "class_id" in ob.data.attributes]


def ids_of(cloud: Any, name: str) -> NDArray[np.int32]:
    """The integer attribute `name` of a cloud's points or of a mesh's vertices, int32 [N]; zeros where it has none."""
    values = np.zeros(len(cloud.attributes["position"].data), np.int32)
    if name in cloud.attributes:
        cloud.attributes[name].data.foreach_get("value", values)
    return values


def row_of(root: bpy.types.Collection, instance: int) -> Any:
    """The row of an instance; of the one that is active in the list when `instance` is 0. Raises PlgsError."""
    lists = root.plgs
    if instance == 0:
        if 0 <= lists.instance_index < len(lists.instances):
            return lists.instances[lists.instance_index]
        raise PlgsError("has no instance selected", root.name, "Click an object in the view, or a row of the list.")
    row = next((row for row in lists.instances if row.instance_id == instance), None)
    if row is None:
        ids = ", ".join(str(row.instance_id) for row in lists.instances) or "none"
        raise PlgsError(f"has no instance {instance}", root.name, f"Its instances are {ids}.")
    return row


def class_row_of(root: bpy.types.Collection, class_id: int) -> Any:
    """The row of a class. Raises PlgsError."""
    row = next((row for row in root.plgs.classes if row.class_id == class_id), None)
    if row is None:
        ids = ", ".join(str(row.class_id) for row in root.plgs.classes) or "none"
        raise PlgsError(f"has no points of class {class_id}", root.name, f"Its classes are {ids}.")
    return row
