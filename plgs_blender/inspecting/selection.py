"""Find a lift and its parts by our custom properties, and keep the selection in the view and in the lists the same.

`follow_selected` makes the selected object's row active; `select_row` selects the active row's box. Each does nothing
if the two agree already, so they cannot call each other forever. Boxes that are not selected are hidden, unless the
lift shows all."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import chain
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import PlgsError
from ..boxes import BOX, INSTANCE, MOST_BOXES, NAME, SHOWN, TOGETHER
from ..chosen_scene import absolute
from ..owned import FOLDER, GAUSSIANS, KEY, LIFT, is_same_place, lifts_in, originals, text_of

CUT = "cut"
"""Key of the plane that splits an object."""
CHOSEN = "plgs_chosen"
"""Property of a scene: the lift that the panels show, if it has several."""


def find_lift(scene: bpy.types.Scene, lift: str = "", active: bpy.types.Object | None = None) -> bpy.types.Collection:
    """Return the lift with this folder or collection name, else `active_lift`. Raises PlgsError if there is none."""
    roots = lifts_in(scene)
    if lift:
        named = [root for root in roots if lift == root.name or is_same_place(text_of(root, FOLDER), absolute(lift))]
        if not named:
            raise PlgsError("lift-elsewhere", "is not in this scene", lift, "Name a lift's folder or its collection.")
        return named[0]
    found = active_lift(scene, active)
    if found is None:
        raise PlgsError("no-lift", "has no lift in it", scene.name, "Lift a scene, or open a finished lift.")
    return found


def active_lift(scene: bpy.types.Scene, active: bpy.types.Object | None) -> bpy.types.Collection | None:
    """Return the active object's lift, else the chosen one, else the first with a result, else the first; or None."""
    roots = lifts_in(scene)
    owns = (None if active is None else text_of(active, LIFT), scene.get(CHOSEN))
    of_object = [root for own in owns for root in roots if root[LIFT] == own]
    with_result = [root for root in roots if len(root.plgs.classes)]
    return next(iter((*of_object, *with_result, *roots)), None)


def choose_lift(root: bpy.types.Collection, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    """Let the panels show this lift."""
    active = layer.objects.active
    if active is not None and active.get(LIFT, root[LIFT]) != root[LIFT]:
        layer.objects.active = None  # else its lift would be shown
    scene[CHOSEN] = root[LIFT]


def chosen_row(scene: bpy.types.Scene, active: bpy.types.Object | None) -> Any | None:
    """Return the active row in the list of the lift shown in the panels, None without any."""
    root = active_lift(scene, active)
    if root is None or not 0 <= root.plgs.instance_index < len(root.plgs.instances):
        return None
    return root.plgs.instances[root.plgs.instance_index]


def objects_by_key(root: bpy.types.Collection) -> dict[str, bpy.types.Object]:
    """Return the lift's objects by key ("instance:3", "frame:0012"), even those moved to another collection."""
    scenes = [scene for scene in bpy.data.scenes if root in scene.collection.children_recursive]
    return originals(chain(root.all_objects, *(scene.objects for scene in scenes)), root[LIFT])


def boxes_of(root: bpy.types.Collection) -> dict[int, bpy.types.Object]:
    """Return the boxes by instance id, without those that the user deleted."""
    return {instance_of(ob): ob for ob in objects_by_key(root).values() if is_box(ob)}


def box_of(root: bpy.types.Collection, instance: int) -> bpy.types.Object:
    """Return the box of an instance (0: the list's active one). Raises PlgsError if it has none."""
    row, objects = row_of(root, instance), objects_by_key(root)
    box = objects.get(f"{INSTANCE}{row.instance_id}")
    if box is None and TOGETHER in objects:
        fix = f"Choose one of the {MOST_BOXES} objects with the most points."
        raise PlgsError("no-box", "has no box of its own, as there are so many objects", row.name, fix)
    if box is None:
        raise PlgsError("box-gone", "has lost its box", row.name, "Show the lift's result again.")
    return box


def is_box(ob: bpy.types.Object | None) -> bool:
    """Whether an object is the box of some lift's instance."""
    return ob is not None and text_of(ob, KEY).startswith(INSTANCE) and instance_of(ob) > 0


def instance_of(ob: bpy.types.Object | None) -> int:
    """Return the id of the instance whose box or mesh an object is; 0 for any other object."""
    if ob is None or not text_of(ob, LIFT):
        return 0
    kind, _, number = text_of(ob, KEY).partition(":")
    number = number.rpartition(":")[2] if kind == "mesh" else number
    return int(number) if kind in ("instance", "mesh") and number.isdecimal() else 0


def clouds_of(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the objects with semantic points, one per class, and the one with the anchors."""
    return [ob for key, ob in objects_by_key(root).items() if ob.type == "POINTCLOUD" and key != GAUSSIANS]


def surfaces_of(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the lift's splats and meshes: objects with a class at each vertex."""
    of_kind = {key: ob for key, ob in objects_by_key(root).items() if ob.type == "MESH" or key == GAUSSIANS}
    return [ob for ob in of_kind.values() if "class_id" in ob.data.attributes]


def ids_of(cloud: Any, name: str) -> NDArray[np.int32]:
    """The integer attribute `name` of a cloud's points or a mesh's vertices, int32 [N]; zeros if it is missing."""
    values = np.zeros(len(cloud.attributes["position"].data), np.int32)
    if name in cloud.attributes:
        cloud.attributes[name].data.foreach_get("value", values)
    return values


def values_of(data: Any, name: str, field: str = "vector", width: int = 3) -> NDArray[np.float32]:
    """Return the values of the attribute `name` of a cloud's points or a mesh's vertices, float32 [N, width]."""
    values = np.empty(width * len(data.attributes[name].data), np.float32)
    data.attributes[name].data.foreach_get(field, values)
    return values.reshape(-1, width)


def row_of(root: bpy.types.Collection, instance: int) -> Any:
    """Return the row of an instance (0: the list's active one). Raises PlgsError if there is none."""
    lists = root.plgs
    if instance == 0:
        if 0 <= lists.instance_index < len(lists.instances):
            return lists.instances[lists.instance_index]
        what = "has no instance selected"
        raise PlgsError("no-selection", what, root.name, "Click an object in the view, or a row of the list.")
    row = next((row for row in lists.instances if row.instance_id == instance), None)
    if row is None:
        ids = ", ".join(str(row.instance_id) for row in lists.instances) or "none"
        raise PlgsError("no-object", f"has no instance {instance}", root.name, f"Its instances are {ids}.")
    return row


def class_row_of(root: bpy.types.Collection, class_id: int) -> Any:
    """Return the row of a class in the list. Raises PlgsError if the lift lacks the class."""
    row = next((row for row in root.plgs.classes if row.class_id == class_id), None)
    if row is None:
        ids = ", ".join(str(row.class_id) for row in root.plgs.classes) or "none"
        raise PlgsError("no-such-class", f"has no points of class {class_id}", root.name, f"Its classes are {ids}.")
    return row


renaming: list[Callable[[bpy.types.Collection, int, str], None]] = []
"""Called with an instance's id after its row or box was renamed: `corrections` makes an edit of it."""
choosing: list[Callable[[bpy.types.Collection], None]] = []
"""Called after the active row of a lift's list of instances has changed, as by a click in the view."""
_MSGBUS_OWNER = object()


def selected_instance(root: bpy.types.Collection, active: bpy.types.Object | None) -> int:
    """Return the instance of this lift whose box or mesh is active and selected; 0 if there is no such instance."""
    if active is None or not instance_of(active) or active[LIFT] != root[LIFT]:
        return 0
    return instance_of(active) if active.select_get() else 0


def selected_instances(root: bpy.types.Collection, layer: bpy.types.ViewLayer) -> list[int]:
    """Return the instances of the selected boxes and meshes, the active one first."""
    ours = [ob for ob in objects_by_key(root).values() if instance_of(ob) and ob.select_get(view_layer=layer)]
    ours.sort(key=lambda ob: ob != layer.objects.active)
    return [*dict.fromkeys(map(instance_of, ours))]


def select_instance(
    root: bpy.types.Collection, instance: int, layer: bpy.types.ViewLayer, *, extend: bool = False
) -> None:
    """Make an instance (0: the list's active one) the active row and its box the only selected object; with `extend`,
    add its box to the selection, or remove it. A hidden box stays hidden. Raises PlgsError for another id."""
    if extend and instance in selected_instances(root, layer):
        for ob in objects_by_key(root).values():
            if instance_of(ob) == instance:
                ob.select_set(False, view_layer=layer)
        return
    others = [ob for ob in layer.objects if ob is not None and ob.select_get(view_layer=layer)] if extend else []
    row = row_of(root, instance)
    for index, each in enumerate(root.plgs.instances):
        if each.instance_id == row.instance_id and root.plgs.instance_index != index:
            root.plgs.instance_index = index
            break
    _select_box(root, row.instance_id, layer)
    for ob in others:
        if instance_of(ob):
            ob.hide_set(False, view_layer=layer)
        ob.select_set(True, view_layer=layer)


def select_nothing(root: bpy.types.Collection, class_id: int, layer: bpy.types.ViewLayer) -> None:
    """Deselect all objects, also in the lift's list, and make a class the active row of the class list (-1: none)."""
    deselect_all(layer)
    layer.objects.active, root.plgs.instance_index = None, -1
    hide_unselected(root, layer)
    numbers = [row.class_id for row in root.plgs.classes]
    root.plgs.class_index = numbers.index(class_id) if class_id in numbers else -1


def select_class(root: bpy.types.Collection, class_id: int, layer: bpy.types.ViewLayer) -> int:
    """Select only the boxes of a class, and return their number."""
    boxes = boxes_of(root)
    of_class = [boxes.get(row.instance_id) for row in root.plgs.instances if row.class_id == class_id]
    deselect_all(layer)
    chosen = [box for box in of_class if box is not None and _select(root, box, layer)]
    if chosen:
        layer.objects.active = chosen[0]
    hide_unselected(root, layer)
    return len(chosen)


def select_row(root: bpy.types.Collection, layer: bpy.types.ViewLayer) -> None:
    """Select the box of the list's active row, unless it is selected already."""
    lists = root.plgs
    if not 0 <= lists.instance_index < len(lists.instances):
        return
    number = lists.instances[lists.instance_index].instance_id
    if selected_instance(root, layer.objects.active) != number:
        _select_box(root, number, layer)


def follow_selected(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    """Make the selected object's row active in its lift's list. If nothing of a lift is selected, make no row active;
    but keep the row of a hidden object, whose box cannot be selected, and of an object about to be cut."""
    for root in lifts_in(scene):
        lists = root.plgs
        number = next(iter(selected_instances(root, layer)), 0)
        rows = {row.instance_id: index for index, row in enumerate(lists.instances)}
        row = lists.instances[lists.instance_index] if 0 <= lists.instance_index < len(rows) else None
        plane = objects_by_key(root).get(CUT)
        keeps = number or (plane is not None and plane.select_get(view_layer=layer))
        box = boxes_of(root).get(row.instance_id) if row is not None and not keeps else None
        if number in rows and lists.instance_index != rows[number]:
            lists.instance_index = rows[number]
        elif box is not None and not _is_left_out(root, row):
            lists.instance_index = -1
        hide_unselected(root, layer)


def hide_unselected(root: bpy.types.Collection, layer: bpy.types.ViewLayer) -> None:
    """Hide the boxes that are not selected, unless the lift shows all boxes."""
    for box in () if root.plgs.show_boxes else boxes_of(root).values():
        if layer.objects.get(box.name) == box and not box.select_get(view_layer=layer):
            if not box.hide_get(view_layer=layer):  # hiding makes Blender look through all objects
                box.hide_set(True, view_layer=layer)


def _is_left_out(root: bpy.types.Collection, row: Any) -> bool:
    """Whether a row's instance is hidden in the lists, by its or its class's eye, or as another is isolated."""
    lists = root.plgs
    if lists.isolated:
        return bool(lists.isolated != row.instance_id)
    return not row.visible or any(not each.visible and each.class_id == row.class_id for each in lists.classes)


def _select(root: bpy.types.Collection, box: bpy.types.Object, layer: bpy.types.ViewLayer) -> bool:
    """Show and select a box. Returns whether it is selected now; the box of a hidden object is left alone."""
    row = next((row for row in root.plgs.instances if row.instance_id == instance_of(box)), None)
    if row is None or _is_left_out(root, row) or layer.objects.get(box.name) != box:
        return False
    if not root.plgs.show_boxes and box.hide_get(view_layer=layer):
        box.hide_set(False, view_layer=layer)
    box.select_set(True, view_layer=layer)
    return box.select_get(view_layer=layer)


def _select_box(root: bpy.types.Collection, number: int, layer: bpy.types.ViewLayer) -> None:
    """Select only the box of the instance ``number``. If that is hidden, no object of the lift stays selected."""
    box, selected = boxes_of(root).get(number), [ob for ob in layer.objects if ob is not None and ob.select_get()]
    if box is not None and _select(root, box, layer):
        deselect_all(layer, but=box)
        layer.objects.active = box
    elif instance_of(layer.objects.active):
        for ob in selected:
            if instance_of(ob):
                ob.select_set(False, view_layer=layer)
        layer.objects.active = None
    hide_unselected(root, layer)


def deselect_all(layer: bpy.types.ViewLayer, *, but: bpy.types.Object | None = None) -> None:
    """Deselect all objects; the active one stays active, as in Blender."""
    for ob in layer.objects:
        if ob not in (None, but) and ob.select_get(view_layer=layer):  # removed ones leave holes until the next update
            ob.select_set(False, view_layer=layer)


_followed: list[Any] = []  # the scene, active object and selection when the lists last followed


@bpy.app.handlers.persistent
def follow(*_arguments: object) -> None:
    """Update the lists of the windows' scenes to the windows' selections. It is safe to call at any time."""
    for window in bpy.context.window_manager.windows:
        follow_selected(window.scene, window.view_layer)


def follow_name() -> None:
    """If the user renamed the active box or mesh, as in the outliner, rename the lift's instance that it shows."""
    context = bpy.context
    ob = context.view_layer.objects.active if context.view_layer is not None else None
    if ob is None or not instance_of(ob) or ob.name == ob.get(SHOWN, ob.name):
        return
    without_number = re.sub(r"\.\d{3,}$", "", ob.name)  # Blender adds .001 to a name that is taken
    name = without_number if without_number in bpy.data.objects else ob.name
    name = name.removesuffix(BOX) if is_box(ob) else name
    if text_of(ob, NAME) in (name, without_number.removesuffix(BOX)):
        return
    for root in lifts_in(context.scene):
        if objects_by_key(root).get(text_of(ob, KEY)) == ob:
            for rename in renaming:
                rename(root, instance_of(ob), name)
            bpy.ops.ed.undo_push(message="Rename Object")


@bpy.app.handlers.persistent
def _after_update(scene: bpy.types.Scene, *_arguments: object) -> None:
    """Update the lists a moment later, because the selection must not change during an update."""
    layer = bpy.context.view_layer
    if layer is None or layer.id_data != scene or bpy.app.background:
        return
    now = [scene.session_uid, layer.objects.active, *layer.objects.selected]
    now[1:] = [ob and ob.session_uid for ob in now[1:]]  # objects may be gone at the next update
    if now != _followed:
        _followed[:] = now
        if not bpy.app.timers.is_registered(follow):
            bpy.app.timers.register(follow, first_interval=0.0)


@bpy.app.handlers.persistent
def _subscribe(*_arguments: object) -> None:
    """Subscribe to name changes, again after loading a file, which ends all subscriptions."""
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    key = bpy.types.Object, "name"
    bpy.msgbus.subscribe_rna(key=key, owner=_MSGBUS_OWNER, args=(), notify=follow_name, options={"PERSISTENT"})


HANDLERS = (
    ("undo_post", follow),
    ("redo_post", follow),
    ("depsgraph_update_post", _after_update),
    ("load_post", _subscribe),
)


def register() -> None:
    _subscribe()


def unregister() -> None:
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
