"""What of a lift is shown: the eyes of its lists, and one instance alone.

Boxes and the points of a class are objects, which have eyes of their own. The points of an instance are part of its
class's cloud: they carry the attribute `plgs_hidden`, and a modifier that is there only while something is hidden
leaves them out, in the view and in renders.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.scene import VOID
from ..owned import LIFT, key_of, tag
from .lookup import boxes_of, clouds_of, row_of
from .once_for_many import OnceForMany

HIDDEN = "plgs_hidden"
MODIFIER = "Hidden instances"
_GROUP = "hidden instances"


@OnceForMany
def apply_visibility(root: bpy.types.Collection) -> None:
    """Bring boxes and points in line with the lift's lists."""
    lists = root.plgs
    boxes = boxes_of(root)
    class_of = {row.instance_id: row.class_id for row in lists.instances}
    classes = np.array([class_of.get(instance, VOID) for instance in boxes], np.int32)
    for box, hidden in zip(boxes.values(), _left_out(lists, np.array([*boxes], np.int32), classes), strict=True):
        _show_object(box, not hidden)
    eyes = {row.class_id: row.visible for row in lists.classes}
    for cloud in clouds_of(root):
        if "class_id" in cloud:
            _show_object(cloud, bool(lists.isolated) or eyes.get(cloud["class_id"], True))
        _hide_points(root, cloud, _left_out(lists, _ids(cloud.data, "instance_id"), _ids(cloud.data, "class_id")))


def isolate(root: bpy.types.Collection, instance: int = 0) -> None:
    """Show only one instance (0: the list's active one); again, show what was shown before. Raises JobError."""
    number = row_of(root, instance).instance_id
    root.plgs.isolated = 0 if root.plgs.isolated == number else number


def show_all(root: bpy.types.Collection) -> None:
    """Open all eyes of the lift's lists."""
    with apply_visibility.at_once(root):
        for row in (*root.plgs.instances, *root.plgs.classes):
            row.visible = True
        root.plgs.isolated = 0


def _left_out(lists: bpy.types.PropertyGroup, instance_id: NDArray[np.int32], class_id: NDArray[np.int32]) -> Any:
    """Which things of these instances and classes, int32 [N] each, are not to be seen: bool [N]."""
    if lists.isolated:
        return instance_id != lists.isolated
    instances = [row.instance_id for row in lists.instances if not row.visible]
    classes = [row.class_id for row in lists.classes if not row.visible]
    return np.isin(instance_id, np.array(instances, np.int32)) | np.isin(class_id, np.array(classes, np.int32))


def _show_object(ob: bpy.types.Object, shown: bool) -> None:
    """Set an object's eye in all scenes that have it, and whether renders do."""
    ob.hide_render = not shown
    for scene in bpy.data.scenes:
        for layer in scene.view_layers:
            if layer.objects.get(ob.name) == ob:
                ob.hide_set(not shown, view_layer=layer)


def _hide_points(root: bpy.types.Collection, cloud: bpy.types.Object, hidden: NDArray[np.bool_]) -> None:
    """Leave out a cloud's points, `hidden` bool [N]."""
    attributes = cloud.data.attributes
    modifier, layer = cloud.modifiers.get(MODIFIER), attributes.get(HIDDEN)
    if not hidden.any():
        if layer is not None:
            attributes.remove(layer)
        if modifier is not None:
            cloud.modifiers.remove(modifier)
        return
    layer = layer or attributes.new(HIDDEN, "BOOLEAN", "POINT")
    layer.data.foreach_set("value", hidden)
    cloud.data.update_tag()
    modifier = modifier or cloud.modifiers.new(MODIFIER, "NODES")
    if modifier.node_group is None:
        modifier.node_group = _node_group(root[LIFT], next(iter(cloud.data.materials), None))


def _ids(cloud: bpy.types.PointCloud, name: str) -> NDArray[np.int32]:
    values = np.zeros(len(cloud.points), np.int32)
    if name in cloud.attributes:
        cloud.attributes[name].data.foreach_get("value", values)
    return values


def _node_group(lift: str, material: bpy.types.Material | None) -> bpy.types.NodeTree:
    """The lift's node group that deletes the points whose attribute `plgs_hidden` is true."""
    for tree in bpy.data.node_groups:
        if key_of(tree, lift) == _GROUP:
            return tree
    tree = _new_group(material)
    tag(tree, lift, _GROUP)
    return tree


def _new_group(material: bpy.types.Material | None) -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new("PLGS hidden instances", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    tree.is_modifier = True
    kinds = (
        "NodeGroupInput", "GeometryNodeInputNamedAttribute", "GeometryNodeDeleteGeometry",
        "GeometryNodeSetMaterial", "NodeGroupOutput",
    )  # fmt: skip
    start, hidden, remove, dye, end = (tree.nodes.new(kind) for kind in kinds)
    for column, node in enumerate((start, hidden, remove, dye, end)):
        node.location = (220 * column, 0)
    hidden.data_type, remove.domain = "BOOLEAN", "POINT"
    hidden.inputs["Name"].default_value = HIDDEN
    found = next(socket for socket in hidden.outputs if socket.enabled and socket.name == "Attribute")
    tree.links.new(found, remove.inputs["Selection"])
    tree.links.new(start.outputs[0], remove.inputs["Geometry"])
    # Geometry nodes lose the materials of point clouds.
    dye.inputs["Material"].default_value = material
    tree.links.new(remove.outputs[0], dye.inputs["Geometry"])
    tree.links.new(dye.outputs[0], end.inputs[0])
    return tree
