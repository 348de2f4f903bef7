"""Which parts of a lift are shown, and in which colours.

Boxes and the points of a class are objects, each with its own eye and colour. The points of an instance are
part of its class's cloud: they carry the attribute `plgs_hidden`, and a modifier leaves them out, in the view and in
renders. The modifier is there only while something is hidden.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.posed import VOID
from .. import compat
from ..boxes import INSTANCE, TOGETHER
from ..frames import PATH
from ..materials import object_colour
from ..owned import KEY, LIFT, key_of, tag, text_of
from .looks import CLASSES
from .lookup import boxes_of, clouds_of, ids_of, objects_by_key, row_of, surfaces_of

HIDDEN = "plgs_hidden"
MODIFIER = "Hidden instances"
_GROUP = "hidden instances"
_WIRES, _DOTS = 0.15, 0.01
"""Display sizes of the cameras in metres: to tell each one apart, and the smallest that Blender draws."""


class _OnceForMany:
    """A decorated function brings a lift's objects in line with its lists. Within `at_once` it runs once, at the end,
    however many rows change.
    """

    def __init__(self, apply: Callable[[bpy.types.Collection], None]) -> None:
        self._apply = apply
        self._waiting: list[str] = []
        """Names of the collections whose rows are being changed."""

    def __call__(self, root: bpy.types.Collection) -> None:
        if root.name not in self._waiting:
            self._apply(root)

    @contextmanager
    def at_once(self, root: bpy.types.Collection) -> Iterator[None]:
        """Change many rows, and bring the objects in line afterwards."""
        self._waiting.append(root.name)
        try:
            yield
        finally:
            self._waiting.pop()
        self(root)


@_OnceForMany
def apply_visibility(root: bpy.types.Collection) -> None:
    """Bring boxes and points in line with the lift's lists."""
    lists, is_left_out = root.plgs, leaving_out(root.plgs)
    boxes, together = boxes_of(root), objects_by_key(root).get(TOGETHER)
    for box, hidden in zip(boxes.values(), instances_left_out(lists, boxes), strict=True):
        _show_object(box, not hidden and lists.show_boxes)
    if together is not None:
        _show_object(together, lists.show_boxes)
    eyes = {row.class_id: row.visible for row in lists.classes}
    for cloud in clouds_of(root):
        if "class_id" in cloud:
            _show_object(cloud, bool(lists.isolated) or eyes.get(cloud["class_id"], True))
    for ob in (*clouds_of(root), *surfaces_of(root)):
        _hide_points(root, ob, is_left_out(ids_of(ob.data, "instance_id"), ids_of(ob.data, "class_id")))


@_OnceForMany
def apply_colours(root: bpy.types.Collection) -> None:
    """Colour the clouds by their classes, and the boxes by instances unless the lift's `look` is of classes. Solid
    shading and renders both show the objects' colours.
    """
    lists = root.plgs
    of_class = {row.class_id: _linear(row.colour) for row in lists.classes}
    for cloud in clouds_of(root):
        number = cloud.get("class_id")
        if isinstance(number, int) and number in of_class:
            cloud.color = of_class[number]
    boxes = boxes_of(root)
    for row in lists.instances:
        box = boxes.get(row.instance_id)
        if box is not None:
            own = _linear(row.colour)
            box.color = of_class.get(row.class_id, own) if lists.look == CLASSES else own


def _linear(srgb: bpy.types.bpy_prop_array) -> tuple[float, float, float, float]:
    red, green, blue = (round(255.0 * channel) for channel in srgb)
    return object_colour((red, green, blue))


def size_cameras(root: bpy.types.Collection, large: bool) -> None:
    """Draw the frames' cameras and the moving one large, or so small that they do not look like dirt on the floor.
    They are not hidden: a hidden camera shows no photo."""
    for key, ob in objects_by_key(root).items():
        if ob.type == "CAMERA" and (key == PATH or key.startswith("frame:")):
            ob.data.display_size = _WIRES if large else _DOTS
            ob.hide_select = not large and key != PATH  # a click on what lies behind must not find a dot


def isolate(root: bpy.types.Collection, instance: int = 0) -> None:
    """Show only one instance (0: the list's active one), or what was shown before when it already stands alone. Raises
    PlgsError.
    """
    number = row_of(root, instance).instance_id
    root.plgs.isolated = 0 if root.plgs.isolated == number else number


def show_all(root: bpy.types.Collection) -> None:
    """Show everything in the lift's lists."""
    with apply_visibility.at_once(root):
        for row in (*root.plgs.instances, *root.plgs.classes):
            row.visible = True
        root.plgs.isolated = 0


def leaving_out(lists: bpy.types.PropertyGroup) -> Callable[[NDArray[np.int32], NDArray[np.int32]], Any]:
    """Says whether each thing of some instances and classes, int32 [N] each, is hidden: bool [N]."""
    alone = lists.isolated
    if alone:
        return lambda instance_id, class_id: instance_id != alone
    instances = np.array([row.instance_id for row in lists.instances if not row.visible], np.int32)
    classes = np.array([row.class_id for row in lists.classes if not row.visible], np.int32)
    return lambda instance_id, class_id: np.isin(instance_id, instances) | np.isin(class_id, classes)


def instances_left_out(lists: bpy.types.PropertyGroup, instances: Collection[int]) -> Any:
    """Whether each of N instances is hidden: bool [N]."""
    class_of = {row.instance_id: row.class_id for row in lists.instances}
    classes = np.array([class_of.get(instance, VOID) for instance in instances], np.int32)
    return leaving_out(lists)(np.array([*instances], np.int32), classes)


def _show_object(ob: bpy.types.Object, shown: bool) -> None:
    """Show or hide an object in all scenes that have it, and in renders unless it is a box."""
    not_rendered = not shown or text_of(ob, KEY).startswith((INSTANCE, TOGETHER))
    if ob.hide_render != not_rendered:
        ob.hide_render = not_rendered
    for scene in bpy.data.scenes:
        for layer in scene.view_layers:
            # Hiding an object makes Blender look through all others, so that of thousands it takes seconds.
            if ob.hide_get(view_layer=layer) == shown and layer.objects.get(ob.name) == ob:
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
        # Geometry nodes lose the materials of point clouds; those of meshes stay.
        material = next(iter(cloud.data.materials), None) if cloud.type == "POINTCLOUD" else None
        modifier.node_group = _node_group(root[LIFT], _GROUP if material else f"{_GROUP} of meshes", material)


def _node_group(lift: str, key: str, material: bpy.types.Material | None) -> bpy.types.NodeTree:
    """The lift's node group that deletes the points whose attribute `plgs_hidden` is true, and sets a material."""
    for tree in bpy.data.node_groups:
        if key_of(tree, lift) == key:
            return tree
    tree = _new_group(material)
    tag(tree, lift, key)
    return tree


def _new_group(material: bpy.types.Material | None) -> bpy.types.NodeTree:
    tree = compat.new_geometry_group("PLGS hidden instances")
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
    dye.inputs["Material"].default_value = material
    dye.inputs["Selection"].default_value = material is not None
    tree.links.new(remove.outputs[0], dye.inputs["Geometry"])
    tree.links.new(dye.outputs[0], end.inputs[0])
    return tree
