"""Choosing the instance or class whose matte the compositor's group "PLGS Panoptic" shows."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..engine.errors import PlgsError
from . import compat
from .inspecting.lookup import class_row_of, row_of
from .owned import KEY, LIFT, key_of
from .pass_nodes import CLASSES, INSTANCES, PANOPTIC, PASSES, has_nodes, node_of, panoptic_node
from .passes import SHOT, matte_ids, passes_scene_of

_SHOWING = ("Recolour", "Outline", "Isolate", "Hold out")
"""Controls of the group that make a matte visible."""


def compositors_of(root: bpy.types.Collection) -> Iterator[tuple[bpy.types.Scene, bpy.types.NodeTree]]:
    """The scenes that hold the passes of a lift, the scene of its frames first, with their nodes. Scenes whose nodes
    the user has taken apart are left out.
    """
    found = []
    for scene in bpy.data.scenes:
        key, tree = key_of(scene, root[LIFT]) or "", compat.compositor_tree(scene)
        if tree is not None and has_nodes(tree) and (key == PASSES or key.startswith(SHOT)):
            found.append((key != PASSES, scene, tree))
    for _, scene, tree in sorted(found, key=lambda each: each[0]):
        yield scene, tree


def panoptic_of(scene: bpy.types.Scene) -> bpy.types.Node | None:
    """The node of the group, with its controls, in the compositor that is opened from a scene; None when there is
    none."""
    passes = passes_scene_of(scene)
    tree = None if passes is None else compat.compositor_tree(passes)
    return None if tree is None else next((node for node in tree.nodes if node.get(KEY) == PANOPTIC), None)


def matte_instance(root: bpy.types.Collection, instance: int) -> str:
    """Let the compositor's matte be an instance (0: the list's active one), and return its name. Raises PlgsError."""
    row = row_of(root, instance)
    names = matte_ids({each.instance_id: each.name for each in root.plgs.instances})
    _set(root, INSTANCES, names[row.instance_id], by_class=0.0)
    return str(row.name)


def matte_class(root: bpy.types.Collection, class_id: int) -> str:
    """Let the compositor's matte be a class, and return its name. Raises PlgsError."""
    row = class_row_of(root, class_id)
    if row.class_id == 0:
        raise PlgsError("points without a class have no matte", root.name, "Choose a class in the list.")
    names = matte_ids({each.class_id: each.name for each in root.plgs.classes})
    _set(root, CLASSES, names[row.class_id], by_class=1.0)
    return str(row.name)


def _set(root: bpy.types.Collection, layer: str, name: str, by_class: float) -> None:
    """Set the matte in all scenes with passes of the lift. A matte that no control shows gets an outline."""
    compositors = [tree for _, tree in compositors_of(root)]
    if not compositors:
        raise PlgsError("has no passes in a compositor", root.name, "Bake some in the Passes panel.")
    for tree in compositors:
        node_of(tree, layer).matte_id = name
        if not any(node.get(KEY) == PANOPTIC for node in tree.nodes):
            continue  # the user has built something else of the mattes
        controls = panoptic_node(tree).inputs
        controls["By class"].default_value = by_class
        if not any(controls[each].default_value or controls[each].is_linked for each in _SHOWING):
            controls["Outline"].default_value = 1.0
