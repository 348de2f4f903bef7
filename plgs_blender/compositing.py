"""Show the compositor in a window: its workspace, the passes behind the nodes, the selected group and its matte."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..engine.errors import PlgsError
from ..engine.posed.exr_header import read_exr_header
from ..engine.posed.names import matte_names
from . import compat
from .inspecting.selection import choosing, class_row_of, row_of
from .owned import KEY, LIFT, key_of, scene_to_fill
from .pass_nodes import CRYPTO_CLASSES, CRYPTO_INSTANCES, PANOPTIC, PASSES, has_nodes, node_of
from .passes import SHOT, passes_scene_of

_TREE = "CompositorNodeTree"
_SHARE, _ASIDE = (0.45, 0.42), (-0.05, 0.09)
"""Fractions of the window's width and height: the largest backdrop behind the nodes, and its offset to the left of and
above the middle, where neither nodes nor the sidebar cover it."""
_LARGEST = 3.0  # largest magnification of the backdrop
_MSGBUS_OWNER = object()


@dataclass
class _Opened:
    """What a window showed before the compositor was opened in it: the names of its ``workspace`` and scene (``room``),
    and the cameras that its 3D views looked through (``eyes``), by screen and area index. ``passes`` is the scene that
    was opened, ``last`` the window's last workspace."""

    workspace: str
    room: str
    passes: str
    last: str
    eyes: dict[tuple[str, int], str]

    def go_back(self, window: bpy.types.Window, room: bpy.types.Scene) -> None:
        """Show the room again, through the same cameras; Blender left them, as a passes scene has no camera."""
        window.scene = room
        for (screen, number), name in self.eyes.items():
            areas, camera = getattr(bpy.data.screens.get(screen), "areas", ()), room.objects.get(name)
            if camera is not None and number < len(areas) and areas[number].type == "VIEW_3D":
                space = areas[number].spaces.active
                space.camera, space.region_3d.view_perspective = camera, "CAMERA"


def _eyes(window: bpy.types.Window) -> dict[tuple[str, int], str]:
    found = {}
    for screen in window.workspace.screens:
        for number, area in enumerate(screen.areas):
            if area.type == "VIEW_3D" and area.spaces.active.region_3d.view_perspective == "CAMERA":
                space = area.spaces.active
                camera = space.camera if space.use_local_camera else window.scene.camera
                found[screen.name, number] = "" if camera is None else camera.name
    return found


_opened: dict[int, _Opened] = {}  # opened windows by their address


def show_room(window: bpy.types.Window) -> None:
    """Return from a passes scene to its lift's, in the workspace used before. Raises PlgsError if the scene is gone."""
    room = scene_to_fill(window.scene)
    opened = _opened.pop(window.as_pointer(), None)
    workspace = bpy.data.workspaces.get(opened.workspace) if opened is not None else None
    if workspace is not None and window.workspace == compositing_workspace():
        window.workspace = workspace
    if opened is not None:
        opened.go_back(window, room)
    else:
        window.scene = room


def follow_workspace() -> None:
    """In a window from which the compositor was opened, show the passes in the compositor's workspace and the room in
    all others. If the user chose another scene, the window is left alone."""
    windows = {window.as_pointer(): window for window in bpy.context.window_manager.windows}
    for address, opened in [*_opened.items()]:
        window = windows.get(address)
        room, passes = (bpy.data.scenes.get(name) for name in (opened.room, opened.passes))
        if window is None or room is None or passes is None:
            del _opened[address]
            continue
        before, opened.last = opened.last, window.workspace.name
        compositing = compositing_workspace()
        if compositing is None or opened.last == before or compositing.name not in (before, opened.last):
            continue
        to_passes = window.workspace == compositing
        if window.scene != (room if to_passes else passes):
            del _opened[address]
        elif to_passes:
            window.scene = passes
        else:
            opened.go_back(window, room)


def _follow_soon() -> None:
    """Wait a moment: Blender announces a workspace before its window has switched to it."""
    if not bpy.app.timers.is_registered(follow_workspace):
        bpy.app.timers.register(follow_workspace)


def show_compositor(window: bpy.types.Window, passes: bpy.types.Scene) -> None:
    """Show a passes scene in a window: in the compositing workspace, else in the window's largest area."""
    workspace = compositing_workspace()
    if KEY not in window.scene:
        last = window.workspace.name if workspace is None else workspace.name
        _opened[window.as_pointer()] = _Opened(
            window.workspace.name, window.scene.name, passes.name, last, _eyes(window)
        )
    if workspace is not None:
        window.workspace = workspace
    window.scene = passes
    screen = window.screen if workspace is None else workspace.screens[0]
    editors = [area for area in screen.areas if area.ui_type == _TREE]
    if not editors:
        largest = max(screen.areas, key=lambda area: area.width * area.height)
        largest.ui_type = _TREE
        editors = [largest]
    width, height = passes.render.resolution_x, passes.render.resolution_y
    for area in editors:
        space = area.spaces.active
        space.pin, space.show_backdrop = False, True  # a pinned editor would stay at its old nodes
        space.backdrop_zoom = min(_LARGEST, _SHARE[0] * window.width / width, _SHARE[1] * window.height / height)
        space.backdrop_offset = (_ASIDE[0] * window.width, _ASIDE[1] * window.height)
    select_group(passes)


def compositing_workspace() -> bpy.types.WorkSpace | None:
    """Return the workspace Compositing, else the first with a compositor, else None."""
    spaces = bpy.data.workspaces
    with_compositor = (
        each for each in spaces if any(area.ui_type == _TREE for screen in each.screens for area in screen.areas)
    )
    return spaces.get("Compositing") or next(with_compositor, None)


def select_group(passes: bpy.types.Scene) -> None:
    """Select only the node of the group "PLGS Panoptic", unless the user has removed it."""
    tree = compat.compositor_tree(passes)
    group = _group_node(tree)
    if tree is not None and group is not None:
        for node in tree.nodes:
            node.select = node == group
        tree.nodes.active = group


@bpy.app.handlers.persistent
def _subscribe(*_arguments: object) -> None:
    """Subscribe to workspace changes, again after loading a file, which ends all subscriptions."""
    _opened.clear()
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    key = (bpy.types.Window, "workspace")
    bpy.msgbus.subscribe_rna(key=key, owner=_MSGBUS_OWNER, args=(), notify=_follow_soon, options={"PERSISTENT"})


HANDLERS = (("load_post", _subscribe),)


def register() -> None:
    _subscribe()
    choosing.append(_follow_choice)


def unregister() -> None:
    choosing.remove(_follow_choice)
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    if bpy.app.timers.is_registered(follow_workspace):
        bpy.app.timers.unregister(follow_workspace)
    _opened.clear()


_SHOWING = ("Recolour", "Outline", "Isolate", "Hold out")  # controls of the group that make a matte visible


def compositors_of(root: bpy.types.Collection) -> Iterator[tuple[bpy.types.Scene, bpy.types.NodeTree]]:
    """Yield the scenes with a lift's passes that still have our nodes, with these nodes; the frames' scene first."""
    found = []
    for scene in bpy.data.scenes:
        key, tree = key_of(scene, root[LIFT]) or "", compat.compositor_tree(scene)
        if tree is not None and has_nodes(tree) and (key == PASSES or key.startswith(SHOT)):
            found.append((key != PASSES, scene, tree))
    for _, scene, tree in sorted(found, key=lambda each: each[0]):
        yield scene, tree


def panoptic_of(scene: bpy.types.Scene) -> bpy.types.Node | None:
    """Return the group node with the controls, in the compositor that opens from a scene; None without such a node."""
    passes = passes_scene_of(scene)
    return None if passes is None else _group_node(compat.compositor_tree(passes))


def _group_node(tree: bpy.types.NodeTree | None) -> bpy.types.Node | None:
    return None if tree is None else next((node for node in tree.nodes if node.get(KEY) == PANOPTIC), None)


def _follow_choice(root: bpy.types.Collection) -> None:
    """Make the matte follow the list's active row, if the lift is set so and has passes."""
    if root.plgs.matte_follows and root.plgs.instance_index >= 0:
        with suppress(PlgsError):
            matte_instance(root, 0)


def matte_instance(root: bpy.types.Collection, instance: int) -> str:
    """Make an instance (0: the active one) the compositor's matte; return its name. Raises PlgsError if it has none."""
    row = row_of(root, instance)
    names = matte_names({each.instance_id: each.name for each in root.plgs.instances})
    _set(root, CRYPTO_INSTANCES, names[row.instance_id], by_class=0.0)
    return str(row.name)


def matte_class(root: bpy.types.Collection, class_id: int) -> str:
    """Make a class the compositor's matte, and return its name. Raises PlgsError if the passes lack it."""
    row = class_row_of(root, class_id)
    if row.class_id == 0:
        raise PlgsError("classless", "points without a class have no matte", root.name, "Choose a class in the list.")
    names = matte_names({each.class_id: each.name for each in root.plgs.classes})
    _set(root, CRYPTO_CLASSES, names[row.class_id], by_class=1.0)
    return str(row.name)


def _set(root: bpy.types.Collection, layer: str, name: str, by_class: float) -> None:
    """Make ``name`` the matte of a ``layer`` in all the lift's passes scenes whose files have it. ``by_class`` is 1 for
    a class, 0 for an instance. If no control shows the matte, it gets an outline. Raises PlgsError if files lack it."""
    compositors = [*compositors_of(root)]
    if not compositors:
        raise PlgsError("no-passes", "has no passes in a compositor", root.name, "Bake some in the Passes panel.")
    without = [scene.name for scene, tree in compositors if not _has_matte(tree, layer, name)]
    for tree in (tree for scene, tree in compositors if scene.name not in without):
        node_of(tree, layer).matte_id = name
        group = _group_node(tree)
        if group is None:
            continue  # the user removed it
        controls = group.inputs
        controls["By class"].default_value = by_class
        if not any(controls[each].default_value or controls[each].is_linked for each in _SHOWING):
            controls["Outline"].default_value = 1.0
    if without:
        fix = "Its passes were baked before the object had this name: bake them again."
        raise PlgsError("no-matte", f"has no matte of {name}", ", ".join(without), fix)


def _has_matte(tree: bpy.types.NodeTree, layer: str, name: str) -> bool:
    """Whether the manifest of the passes (Cryptomatte 1.2) has the name; true if the file cannot be read. A node shows
    black for a name that its file lacks."""
    image = node_of(tree, layer).image
    if image is None:
        return True
    try:
        attributes = read_exr_header(Path(bpy.path.abspath(image.filepath))).attributes
        key = next(key for key, (_, value) in attributes.items() if key.endswith(b"/name") and value == layer.encode())
        return name in json.loads(attributes[key.replace(b"/name", b"/manifest")][1])
    except (PlgsError, StopIteration, KeyError, ValueError, TypeError):
        return True
