"""Preparing the window for compositing: the Compositing workspace, the passes behind the nodes, the group selected."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from . import compat
from .lift_collection import scene_to_fill
from .owned import KEY
from .pass_nodes import PANOPTIC

_TREE = "CompositorNodeTree"
_SHARE, _ASIDE = (0.45, 0.42), (-0.05, 0.09)
"""Shares of the window's width and height: what the picture behind the nodes fills at most, and how far it is placed
left of the middle and above it, where neither nodes nor the sidebar cover it.
"""
_LARGEST = 3.0
"""The picture is enlarged at most this much."""
_MSGBUS_OWNER = object()


@dataclass
class _Opened:
    """A window in which the compositor was asked for: the names of the workspace and the scene that it showed then, of
    the passes scene, and of the workspace that it showed last.
    """

    workspace: str
    room: str
    passes: str
    last: str


_opened: dict[int, _Opened] = {}
"""By the address of the window."""


def show_room(window: bpy.types.Window) -> None:
    """Show the scene with the lift again that a passes scene belongs to, in the workspace from which the compositor was
    asked for. Raises PlgsError when the lift's scene is gone.
    """
    room = scene_to_fill(window.scene)
    opened = _opened.pop(window.as_pointer(), None)
    workspace = bpy.data.workspaces.get(opened.workspace) if opened is not None else None
    if workspace is not None and window.workspace == compositing_workspace():
        window.workspace = workspace
    window.scene = room


def follow_workspace() -> None:
    """Show the room in a window in which the compositor was asked for and that leaves its workspace, and the passes
    when it returns. A window in which the user chose another scene is theirs.
    """
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
        shown, other = (passes, room) if window.workspace == compositing else (room, passes)
        if window.scene == other:
            window.scene = shown
        else:
            del _opened[address]


def _follow_soon() -> None:
    """Blender tells of a workspace before its window has it."""
    if not bpy.app.timers.is_registered(follow_workspace):
        bpy.app.timers.register(follow_workspace)


def show_compositor(window: bpy.types.Window, passes: bpy.types.Scene) -> None:
    """Show a passes scene in a compositor of a window: that of the Compositing workspace, or of another one that has a
    compositor. If there is none, the largest area of the window becomes one."""
    workspace = compositing_workspace()
    if KEY not in window.scene:
        last = window.workspace.name if workspace is None else workspace.name
        _opened[window.as_pointer()] = _Opened(window.workspace.name, window.scene.name, passes.name, last)
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
        space.pin, space.show_backdrop = False, True
        space.backdrop_zoom = min(_LARGEST, _SHARE[0] * window.width / width, _SHARE[1] * window.height / height)
        space.backdrop_offset = (_ASIDE[0] * window.width, _ASIDE[1] * window.height)
    select_group(passes)


def compositing_workspace() -> bpy.types.WorkSpace | None:
    """The workspace Compositing, or else the first with a compositor; None when the file has none."""
    spaces = bpy.data.workspaces
    with_compositor = (
        each for each in spaces if any(area.ui_type == _TREE for screen in each.screens for area in screen.areas)
    )
    return spaces.get("Compositing") or next(with_compositor, None)


def select_group(passes: bpy.types.Scene) -> None:
    """Select only the node with the group, unless the user has removed it."""
    tree = compat.compositor_tree(passes)
    group = None if tree is None else next((node for node in tree.nodes if node.get(KEY) == PANOPTIC), None)
    if tree is None or group is None:
        return
    for node in tree.nodes:
        node.select = node == group
    tree.nodes.active = group


@bpy.app.handlers.persistent
def _subscribe(*_arguments: object) -> None:
    """Subscribe to changes of windows' workspaces, also after a file was loaded: loading ends all subscriptions."""
    _opened.clear()
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    key = (bpy.types.Window, "workspace")
    bpy.msgbus.subscribe_rna(key=key, owner=_MSGBUS_OWNER, args=(), notify=_follow_soon, options={"PERSISTENT"})


def register() -> None:
    bpy.app.handlers.load_post.append(_subscribe)
    _subscribe()


def unregister() -> None:
    bpy.msgbus.clear_by_owner(_MSGBUS_OWNER)
    bpy.app.handlers.load_post.remove(_subscribe)
    if bpy.app.timers.is_registered(follow_workspace):
        bpy.app.timers.unregister(follow_workspace)
    _opened.clear()
