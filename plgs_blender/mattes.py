"""The matte of the compositor's group "PLGS Panoptic": of which instance, or which class."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..engine.job import JobError
from ..engine.scene.matte_names import matte_names
from . import compat
from .inspecting.lookup import class_row_of, row_of
from .owned import KEY, LIFT, key_of
from .pass_nodes import CLASSES, INSTANCES, PANOPTIC, PASSES, has_nodes, node_of, panoptic_node
from .passes import SHOT

_SHOWING = ("Recolour", "Outline", "Isolate", "Hold out")
"""Controls of the group with which a matte is seen."""


def compositors_of(root: bpy.types.Collection) -> Iterator[tuple[bpy.types.Scene, bpy.types.NodeTree]]:
    """The scenes that hold the passes of a lift, those of its frames first, and their nodes; none that the user has
    taken apart."""
    found = []
    for scene in bpy.data.scenes:
        key, tree = key_of(scene, root[LIFT]) or "", compat.compositor_tree(scene)
        if tree is not None and has_nodes(tree) and (key == PASSES or key.startswith(SHOT)):
            found.append((key != PASSES, scene, tree))
    for _, scene, tree in sorted(found, key=lambda each: each[0]):
        yield scene, tree


def panoptic_of(root: bpy.types.Collection) -> bpy.types.Node | None:
    """The node of the group, with its controls, in the first of these scenes; None when there is none."""
    for _, tree in compositors_of(root):
        if any(node.get(KEY) == PANOPTIC for node in tree.nodes):
            return panoptic_node(tree)
    return None


def matte_instance(root: bpy.types.Collection, instance: int) -> str:
    """Let the compositor's matte be an instance, the one that is active in the list when `instance` is 0; its name.
    Raises JobError.
    """
    row = row_of(root, instance)
    names = matte_names({each.instance_id: each.name for each in root.plgs.instances})
    _set(root, INSTANCES, names[row.instance_id], by_class=0.0)
    return str(row.name)


def matte_class(root: bpy.types.Collection, class_id: int) -> str:
    """Let the compositor's matte be a class; its name. Raises JobError."""
    row = class_row_of(root, class_id)
    if row.class_id == 0:
        raise JobError("points without a class have no matte", root.name, "Choose a class of the list.")
    names = matte_names({each.class_id: each.name for each in root.plgs.classes})
    _set(root, CLASSES, names[row.class_id], by_class=1.0)
    return str(row.name)


def _set(root: bpy.types.Collection, layer: str, name: str, by_class: float) -> None:
    """In all scenes with passes of the lift. A matte that no control shows gets an outline."""
    compositors = [tree for _, tree in compositors_of(root)]
    if not compositors:
        raise JobError("has no passes in a compositor", root.name, "Bake some in the panel Passes.")
    for tree in compositors:
        node_of(tree, layer).matte_id = name
        if not any(node.get(KEY) == PANOPTIC for node in tree.nodes):
            continue  # the user has built something else of the mattes
        controls = panoptic_node(tree).inputs
        controls["By class"].default_value = by_class
        if not any(controls[each].default_value or controls[each].is_linked for each in _SHOWING):
            controls["Outline"].default_value = 1.0
