"""Show or hide parts of a lift, and colour them.

Materials, Solid shading and renders draw the attribute Col. While Col shows something else, the attribute `photo` keeps
the photos' colours. Boxes, and the points of a class, are objects with their own visibility and colour. The points of
an instance are part of its class's cloud; the attribute `plgs_hidden` marks hidden ones, and a modifier removes
them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.posed import VOID
from .. import compat
from ..boxes import INSTANCE, TOGETHER
from ..cameras import PATH
from ..materials import LIT, PICTURE, add_node, catcher_material, let_catch, linear_rgba, object_colour, value_node
from ..owned import KEY, LIFT, OwnedDataBlocks, is_child, key_of, layer_collections, lifts_in, tag, text_of
from ..splat_objects import dye, read_attribute
from ..viewport import areas_of
from .selection import boxes_of, clouds_of, ids_of, objects_by_key, row_of, surfaces_of, values_of

PHOTO, BY_CLASS, INSTANCES, UNCERTAINTY = "PHOTO", "CLASSES", "INSTANCES", "UNCERTAINTY"
"""Values of a lift's `look`."""
POINTS, SPLATS, SURFACE = "POINTS", "SPLATS", "SURFACE"
"""Values of a lift's `show_as`."""
SHOWN_IN = {POINTS: "Semantic points", SPLATS: "Gaussians", SURFACE: "Meshes"}
"""The collection that each of them shows."""
COLOUR, KEPT = "Col", "photo"

_GREY = np.array([0.3, 0.6, 0.1], np.float32)
"""Channel weights of the grey of points that belong to no instance."""
_RAMP = np.array([[0.02, 0.03, 0.09], [0.45, 0.05, 0.25], [1.0, 0.75, 0.15]], np.float32)
"""Linear colours at confidence 1, 0.5 and 0."""
SURENESS = (("sure", (0.15, 0.19, 0.33)), ("in doubt", (0.7, 0.25, 0.54)), ("unknown", (1.0, 0.88, 0.42)))
"""The legend of these colours, in sRGB."""
_CELL = 0.1  # side in metres of the cells in which surfaces and splats take the confidence of points


def apply_look(root: bpy.types.Collection) -> None:
    """Colour points, splats and meshes by the lift's `look`."""
    look = root.plgs.look
    objects = [ob for ob in objects_by_key(root).values() if ob.type in ("POINTCLOUD", "MESH")]
    coloured = [ob for ob in objects if {COLOUR, "class_id"} <= {*ob.data.attributes.keys()}]
    sure = _Sureness(coloured) if look == UNCERTAINTY else None
    rows, name = (root.plgs.classes, "class_id") if look == BY_CLASS else (root.plgs.instances, "instance_id")
    palette = {getattr(row, name): linear_rgba([round(255.0 * channel) for channel in row.colour]) for row in rows}
    for ob in coloured:
        colours = photo = _photo(ob.data)
        if look in (BY_CLASS, INSTANCES):
            colours = _by_id(ids_of(ob.data, name), palette, photo)
        elif sure is not None:
            colours = sure.colours(ob)
        values = np.ascontiguousarray(colours, np.float32).ravel()  # foreach_set copies such an array at once
        ob.data.attributes[COLOUR].data.foreach_set("color", values)
        dye(ob.data)
        kept = ob.data.attributes.get(KEPT)
        if look == PHOTO and kept is not None:
            ob.data.attributes.remove(kept)
        ob.data.update_tag()
    _set_in_materials(root, PICTURE, look == PHOTO)


def apply_lit(root: bpy.types.Collection) -> None:
    """Light the lift's meshes with the scene's lights, or show them unlit, as its `lit` says."""
    _set_in_materials(root, LIT, root.plgs.lit)


def apply_catcher(root: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    """Make the lift's meshes shadow catchers if `catch_shadows` is on, with a clear background, else visible."""
    catcher = catcher_material(OwnedDataBlocks(root[LIFT], scene), scene) if root.plgs.catch_shadows else None
    for key, ob in objects_by_key(root).items():
        if key.startswith("mesh:") and (catcher is not None or ob.is_shadow_catcher):
            let_catch(ob, catcher)
    scene.render.film_transparent |= catcher is not None  # it is never switched off: the user may have set it


def _set_in_materials(root: bpy.types.Collection, label: str, value: float) -> None:
    for material in bpy.data.materials:
        node = value_node(material, label) if key_of(material, root[LIFT]) is not None else None
        if node is not None:
            node.outputs[0].default_value = float(value)


def apply_show_as(root: bpy.types.Collection) -> None:
    """Show what the lift's `show_as` says and hide everything else, in views and renders."""
    for kind, name in SHOWN_IN.items():
        for child in root.children:
            if is_child(child, root, name):
                child.hide_viewport = child.hide_render = kind != root.plgs.show_as


def shows_pictures(root: bpy.types.Collection) -> bool:
    """Whether a lift is shown as meshes with textures from the photos, and as nothing else."""
    lists = root.plgs
    if (lists.show_as, lists.look, lists.catch_shadows) != (SURFACE, PHOTO, False):
        return False
    return any((key_of(image, root[LIFT]) or "").startswith("mesh:") for image in bpy.data.images)


def show_pictures_in(scene: bpy.types.Scene) -> None:
    """Let 3D views with our Solid shading show the pictures of meshes if all lifts are shown as such meshes; anything
    without a picture would be white. Crevices are darkened then, or a user's own object would be a silhouette."""
    roots = lifts_shown(scene, scene.view_layers[0])
    has_all = bool(roots) and all(map(shows_pictures, roots))
    for shading in (area.spaces.active.shading for area in areas_of(scene)):
        is_ours = (shading.type, shading.light, shading.wireframe_color_type) == ("SOLID", "FLAT", "OBJECT")
        if is_ours and shading.color_type in ("VERTEX", "TEXTURE"):
            shading.color_type = "TEXTURE" if has_all else "VERTEX"
            shading.show_cavity, shading.cavity_type = has_all, "WORLD"


def lifts_shown(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> list[bpy.types.Collection]:
    """Return the scene's lifts whose collections are neither hidden nor excluded in a view layer."""
    visible = {each.collection for each in layer_collections(layer.layer_collection) if each.is_visible}
    return [root for root in lifts_in(scene) if root in visible]


def has(root: bpy.types.Collection, kind: str) -> bool:
    """Whether the lift has objects to show as `kind`, a value of `show_as`: points, splats or a surface."""
    return any(is_child(child, root, SHOWN_IN[kind]) and len(child.all_objects) for child in root.children)


def _photo(data: Any) -> NDArray[np.float32]:
    """Return the photos' linear colours float32 [N, 4], which the first call saves apart from Col."""
    if KEPT in data.attributes:
        return values_of(data, KEPT, "color", 4)
    colours = values_of(data, COLOUR, "color", 4)
    layer = data.attributes.new(KEPT, data.attributes[COLOUR].data_type, "POINT")
    if data.id_type == "MESH":  # a new colour attribute must not become the active one
        data.color_attributes.active_color = data.color_attributes[COLOUR]
    layer.data.foreach_set("color", colours.ravel())
    return colours


def _by_id(
    ids: NDArray[np.int32], palette: dict[int, NDArray[np.float32]], photo: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the colours [N, 4] of ids [N]; a dark grey version of the photo for ids that are not in the palette."""
    colours = np.ones_like(photo)
    colours[:, :3] = 0.35 * (photo[:, :3] @ _GREY)[:, None]
    for number, colour in palette.items():
        colours[ids == number] = colour
    return colours


class _Sureness:
    """Colours that show how certain the views were of the label at a position."""

    def __init__(self, coloured: list[bpy.types.Object]) -> None:
        clouds = [ob for ob in coloured if "confidence" in ob.data.attributes]
        cells = (
            _cells(np.concatenate([values_of(ob.data, "position") for ob in clouds]))
            if clouds
            else np.zeros(0, np.int64)
        )
        sure = np.concatenate([_confidence(ob.data) for ob in clouds]) if clouds else np.zeros(0, np.float32)
        self._cells, rows, count = np.unique(cells, return_inverse=True, return_counts=True)
        self._mean = np.bincount(rows.ravel(), sure, len(self._cells)) / np.maximum(count, 1)

    def colours(self, ob: bpy.types.Object) -> NDArray[np.float32]:
        """Return linear colours float32 [N, 4], brighter where views were less certain; dark without points."""
        if "confidence" in ob.data.attributes:
            sure = _confidence(ob.data)
        else:
            cells = _cells(values_of(ob.data, "position"))
            at = np.minimum(np.searchsorted(self._cells, cells), max(len(self._cells) - 1, 0))
            known = self._cells[at] == cells if len(self._cells) else np.zeros(len(cells), bool)
            sure = np.where(known, self._mean[at] if len(self._mean) else 1.0, 1.0)
        colours = np.ones((len(sure), 4), np.float32)
        for channel in range(3):
            colours[:, channel] = np.interp(1.0 - sure, (0.0, 0.5, 1.0), _RAMP[:, channel])
        return colours


def _confidence(data: Any) -> NDArray[np.float32]:
    """Return the confidence of a cloud's points, float32 [N], 0..1."""
    return np.clip(np.nan_to_num(values_of(data, "confidence", "value", 1)[:, 0]), 0.0, 1.0)


def _cells(xyz: NDArray[np.float32]) -> NDArray[np.int64]:
    """The number of each position's cell, int64 [N]. Cells more than 100 km from the origin share numbers."""
    x, y, z = (np.floor(xyz / _CELL).astype(np.int64) + (1 << 20)).T  # 21 bits each, none negative
    return (x << 42) | (y << 21) | z


_CRUMBS = 0.1  # fraction of a box's sides by which an isolated instance may extend beyond it
HIDDEN = "plgs_hidden"
MODIFIER = "Hidden instances"
_GROUP = "hidden instances"
_WIRES, _DOTS = 0.15, 0.01
"""Display sizes of cameras in metres: large enough to tell them apart, and the smallest that Blender draws."""


class _OnceForMany:
    """Decorates functions that update a lift's objects from its lists: within `at_once` they run once, at the end."""

    def __init__(self, apply: Callable[[bpy.types.Collection], None]) -> None:
        self._apply = apply
        self._waiting: list[str] = []
        """Names of the collections whose rows are being changed."""

    def __call__(self, root: bpy.types.Collection) -> None:
        if root.name not in self._waiting:
            self._apply(root)

    @contextmanager
    def at_once(self, root: bpy.types.Collection) -> Iterator[None]:
        """Delay the function in a ``with`` block that changes many rows, and call it once at the end."""
        self._waiting.append(root.name)
        try:
            yield
        finally:
            self._waiting.pop()
        self(root)


@_OnceForMany
def apply_visibility(root: bpy.types.Collection) -> None:
    """Update the visibility of boxes and points from the lift's lists."""
    lists, is_left_out = root.plgs, leaving_out(root.plgs)
    boxes, together = boxes_of(root), objects_by_key(root).get(TOGETHER)
    for box, hidden in zip(boxes.values(), instances_left_out(lists, boxes), strict=True):
        _show_object(box, not hidden and (lists.show_boxes or None))
    if together is not None:
        _show_object(together, lists.show_boxes)
    eyes = {row.class_id: row.visible for row in lists.classes}
    for cloud in clouds_of(root):
        if "class_id" in cloud:
            _show_object(cloud, bool(lists.isolated) or eyes.get(cloud["class_id"], True))
    alone = boxes.get(lists.isolated)
    for ob in (*clouds_of(root), *surfaces_of(root)):
        hidden = is_left_out(ids_of(ob.data, "instance_id"), ids_of(ob.data, "class_id"))
        _hide_points(root, ob, hidden if alone is None else hidden | _is_crumb(ob, alone))


def _is_crumb(ob: bpy.types.Object, box: bpy.types.Object) -> NDArray[np.bool_]:
    """Return which points or vertices are too far outside their instance's box to belong to it, bool [N]."""
    to_box = np.array(box.matrix_world.inverted() @ ob.matrix_world, np.float32)
    corners = np.array(box.bound_box, np.float32)
    margin = _CRUMBS * np.ptp(corners, axis=0)
    local = values_of(ob.data, "position") @ to_box[:3, :3].T + to_box[:3, 3]
    return ((local < corners.min(axis=0) - margin) | (local > corners.max(axis=0) + margin)).any(axis=1)


@_OnceForMany
def apply_colours(root: bpy.types.Collection) -> None:
    """Give clouds the colours of their classes, and boxes those of their instances, or classes if `look` says so."""
    lists = root.plgs
    of_class = {row.class_id: _box_colour(row.colour) for row in lists.classes}
    for cloud in clouds_of(root):
        number = cloud.get("class_id")
        if isinstance(number, int) and number in of_class:
            cloud.color = of_class[number]
    boxes = boxes_of(root)
    for row in lists.instances:
        box = boxes.get(row.instance_id)
        if box is not None:
            own = _box_colour(row.colour)
            box.color = of_class.get(row.class_id, own) if lists.look == BY_CLASS else own


def _box_colour(srgb: bpy.types.bpy_prop_array) -> tuple[float, float, float, float]:
    red, green, blue = (round(255.0 * channel) for channel in srgb)
    return object_colour((red, green, blue))


def size_cameras(root: bpy.types.Collection) -> None:
    """Draw the frames' cameras and the moving one, or make them tiny. A hidden camera would show no photo."""
    large = root.plgs.show_cameras
    for key, ob in objects_by_key(root).items():
        if ob.type == "CAMERA" and (key == PATH or key.startswith("frame:")):
            ob.data.display_size = _WIRES if large else _DOTS
            ob.hide_select = not large and key != PATH  # a click on what lies behind must not find a dot


def isolate(root: bpy.types.Collection, instance: int = 0) -> None:
    """Show only one instance (0: the list's active one); all if it was alone. Raises PlgsError if it is unknown."""
    number = row_of(root, instance).instance_id
    root.plgs.isolated = 0 if root.plgs.isolated == number else number


def hide(root: bpy.types.Collection, instances: Collection[int]) -> None:
    """Hide instances: their boxes, points and meshes."""
    with apply_visibility.at_once(root):
        for row in root.plgs.instances:
            row.visible = row.visible and row.instance_id not in instances
        if root.plgs.isolated in instances:
            root.plgs.isolated = 0


def show_all(root: bpy.types.Collection) -> None:
    """Show everything in the lift's lists."""
    with apply_visibility.at_once(root):
        for row in (*root.plgs.instances, *root.plgs.classes):
            row.visible = True
        root.plgs.isolated = 0


REMOVED = "plgs_removed"
"""Property of a lift's collection: the names of the removed objects by id, as JSON."""


def removed_objects(root: bpy.types.Collection) -> dict[int, str]:
    """Return the names of the objects that were taken out of a placed lift, by id."""
    try:
        content = json.loads(text_of(root, REMOVED) or "{}")
        return {int(number): str(name) for number, name in content.items()}
    except (ValueError, TypeError, AttributeError):  # a file may come from somebody else
        return {}


def leaving_out(lists: bpy.types.PropertyGroup) -> Callable[[NDArray[np.int32], NDArray[np.int32]], Any]:
    """Return a function that maps instances and classes, int32 [N] each, to whether each is hidden, bool [N]."""
    alone = lists.isolated
    if alone:
        return lambda instance_id, class_id: instance_id != alone
    hidden = [row.instance_id for row in lists.instances if not row.visible]
    instances = np.array([*hidden, *removed_objects(lists.id_data)], np.int32)  # meshes may still have the removed
    classes = np.array([row.class_id for row in lists.classes if not row.visible], np.int32)
    return lambda instance_id, class_id: np.isin(instance_id, instances) | np.isin(class_id, classes)


def instances_left_out(lists: bpy.types.PropertyGroup, instances: Collection[int]) -> Any:
    """Return which of the N `instances` are hidden by the lift's lists, bool [N]."""
    class_of = {row.instance_id: row.class_id for row in lists.instances}
    classes = np.array([class_of.get(instance, VOID) for instance in instances], np.int32)
    return leaving_out(lists)(np.array([*instances], np.int32), classes)


def _show_object(ob: bpy.types.Object, shown: bool | None) -> None:
    """Show or hide an object in all scenes and, unless it is a box, in renders. None: show it where it is selected."""
    not_rendered = not shown or text_of(ob, KEY).startswith((INSTANCE, TOGETHER))
    if ob.hide_render != not_rendered:  # setting an equal value makes Blender update the object, too
        ob.hide_render = not_rendered
    layers = [layer for scene in bpy.data.scenes for layer in scene.view_layers if layer.objects.get(ob.name) == ob]
    for layer in layers:
        wanted = ob.select_get(view_layer=layer) if shown is None else shown
        if ob.hide_get(view_layer=layer) == wanted:  # hiding makes Blender look through all objects
            ob.hide_set(not wanted, view_layer=layer)


def _hide_points(root: bpy.types.Collection, cloud: bpy.types.Object, hidden: NDArray[np.bool_]) -> None:
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
        key = _GROUP if material else f"{_GROUP} of meshes"
        tree = next((each for each in bpy.data.node_groups if key_of(each, root[LIFT]) == key), None)
        if tree is None:
            tree = _new_group(material)
            tag(tree, root[LIFT], key)
        modifier.node_group = tree


def _new_group(material: bpy.types.Material | None) -> bpy.types.NodeTree:
    """Make a node group that deletes points whose attribute `plgs_hidden` is true and sets a material, if any."""
    tree = compat.new_geometry_group("PLGS hidden instances")
    start = add_node(tree, "NodeGroupInput", 0, 0).outputs[0]
    hidden = read_attribute(tree, HIDDEN, 1, 0, "BOOLEAN")
    kept = add_node(tree, "GeometryNodeDeleteGeometry", 2, 0, start, hidden, domain="POINT").outputs[0]
    dyed = add_node(tree, "GeometryNodeSetMaterial", 3, 0, kept, material is not None, material).outputs[0]
    add_node(tree, "NodeGroupOutput", 4, 0, dyed)
    return tree
