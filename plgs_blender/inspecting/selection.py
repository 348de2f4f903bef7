"""One selection everywhere: the box or mesh that is active in the view and the row that is active in the list.

Blender's own selection of them decides. `follow_active` moves the list's active row to it, `select_row` selects
the box of the list's active row. Each does nothing when both agree, so they cannot chase each other. What the view
highlights is read from the selection while drawing.

Blender notifies this module when another object becomes active, and after undo and loading: then the lists follow.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import bpy

from ..boxes import NAME, SHOWN
from ..lift_collection import lifts_in
from ..owned import LIFT, text_of
from .lookup import boxes_of, instance_of, is_box, objects_by_key, row_of

renaming: list[Callable[[bpy.types.Collection, int, str], None]] = []
"""Called with an instance's id whose row or box was given another name: `corrections` makes an edit of it."""
_MSGBUS_OWNER = object()


def selected_instance(root: bpy.types.Collection, active: bpy.types.Object | None) -> int:
    """The instance whose box or mesh is the active object and selected, 0 when none of this lift is. A box that is
    switched off cannot be selected, and is chosen while it is active.
    """
    if active is None or not instance_of(active) or active[LIFT] != root[LIFT]:
        return 0
    return instance_of(active) if active.select_get() or not root.plgs.show_boxes else 0


def selected_instances(root: bpy.types.Collection, layer: bpy.types.ViewLayer) -> list[int]:
    """The instances of the selected boxes and meshes, the active one first; empty when there are none."""
    ours = [ob for ob in objects_by_key(root).values() if instance_of(ob) and ob.select_get(view_layer=layer)]
    ours.sort(key=lambda ob: ob != layer.objects.active)
    return [*dict.fromkeys(map(instance_of, ours))]


def select_instance(
    root: bpy.types.Collection, instance: int, layer: bpy.types.ViewLayer, *, extend: bool = False
) -> None:
    """Make an instance (0: the list's active one) the active row, and its box the only selected object; with `extend`
    one more, or one less where it is selected.

    Raises PlgsError when the lift has no such instance. A hidden box stays as it is; where there is none, no other
    object of the lift stays selected.
    """
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
        ob.select_set(True, view_layer=layer)


def select_nothing(root: bpy.types.Collection, class_id: int, layer: bpy.types.ViewLayer) -> None:
    """Deselect all objects, and make a class the active row of the list of classes."""
    deselect_all(layer)
    if not root.plgs.show_boxes:
        layer.objects.active = None
    numbers = [row.class_id for row in root.plgs.classes]
    root.plgs.class_index = numbers.index(class_id) if class_id in numbers else -1


def select_class(root: bpy.types.Collection, class_id: int, layer: bpy.types.ViewLayer) -> int:
    """Select the boxes of a class and nothing else. Returns how many boxes that are."""
    boxes = boxes_of(root)
    of_class = [boxes.get(row.instance_id) for row in root.plgs.instances if row.class_id == class_id]
    chosen = [box for box in of_class if box is not None and box.visible_get(view_layer=layer)]
    deselect_all(layer)
    for box in chosen:
        box.select_set(True, view_layer=layer)
    if chosen:
        layer.objects.active = chosen[0]
    return len(chosen)


def select_row(root: bpy.types.Collection, layer: bpy.types.ViewLayer) -> None:
    """Select the box of the list's active row, unless it is selected."""
    lists = root.plgs
    if not 0 <= lists.instance_index < len(lists.instances):
        return
    number = lists.instances[lists.instance_index].instance_id
    if selected_instance(root, layer.objects.active) != number:
        _select_box(root, number, layer)


def follow_active(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    """Make the row of the active object active in its lift's list, where that is the box or mesh of an instance."""
    active = layer.objects.active
    if not instance_of(active):
        return
    for root in lifts_in(scene):
        number = selected_instance(root, active)
        for index, row in enumerate(root.plgs.instances if number else ()):
            if row.instance_id == number and root.plgs.instance_index != index:
                root.plgs.instance_index = index


def _select_box(root: bpy.types.Collection, number: int, layer: bpy.types.ViewLayer) -> None:
    box = boxes_of(root).get(number)
    is_off = not root.plgs.show_boxes
    if box is None and instance_of(layer.objects.active):  # commands must not act on the object that was active before
        for ob in objects_by_key(root).values():
            if instance_of(ob):
                ob.select_set(False, view_layer=layer)
        layer.objects.active = None
    if box is None or layer.objects.get(box.name) != box or not (is_off or box.visible_get(view_layer=layer)):
        return
    deselect_all(layer)
    if not is_off:
        box.select_set(True, view_layer=layer)
    layer.objects.active = box


def deselect_all(layer: bpy.types.ViewLayer) -> None:
    """Deselect all objects; the active one stays active, as Blender has it."""
    for ob in layer.objects:
        if ob is not None and ob.select_get(view_layer=layer):  # removed objects leave holes until the next update
            ob.select_set(False, view_layer=layer)


def follow() -> None:
    """Move the lists of the current scene to its active object. Blender calls this; it is safe at any time."""
    context = bpy.context
    if context.scene is not None and context.view_layer is not None:
        follow_active(context.scene, context.view_layer)


def follow_name() -> None:
    """Rename the instance whose box is the active object where that was renamed, as the outliner does. Blender calls
    this. What Blender makes of a name, shorter or with a number, is no name.
    """
    context = bpy.context
    box = context.view_layer.objects.active if context.view_layer is not None else None
    if box is None or not is_box(box) or box.name == text_of(box, SHOWN):
        return
    without_number = re.sub(r"\.\d{3,}$", "", box.name)
    if without_number == text_of(box, NAME):
        return
    name = without_number if without_number in bpy.data.objects else box.name
    for root in lifts_in(context.scene):
        if boxes_of(root).get(instance_of(box)) == box:
            for rename in renaming:
                rename(root, instance_of(box), name)
            bpy.ops.ed.undo_push(message="Rename Object")


@bpy.app.handlers.persistent
def _after_undo(*_arguments: object) -> None:
    follow()


@bpy.app.handlers.persistent
def _subscribe(*_arguments: object) -> None:
    """Subscribe to changes of the active object, also after a file was loaded: loading ends all subscriptions."""
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    for kind, name, notify in ((bpy.types.LayerObjects, "active", follow), (bpy.types.Object, "name", follow_name)):
        bpy.msgbus.subscribe_rna(key=(kind, name), owner=_MSGBUS_OWNER, args=(), notify=notify, options={"PERSISTENT"})


def _handlers() -> list[tuple[list, object]]:
    at = bpy.app.handlers
    return [(at.undo_post, _after_undo), (at.redo_post, _after_undo), (at.load_post, _subscribe)]


def register() -> None:
    for handlers, each in _handlers():
        handlers.append(each)
    _subscribe()


def unregister() -> None:
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    for handlers, each in _handlers():
        if each in handlers:
            handlers.remove(each)
