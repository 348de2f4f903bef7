"""Blender tells us when another object becomes active, and after undo and loading: then the lists follow."""

from __future__ import annotations

import bpy

from .selection import follow_active

_OWNER = object()
"""Whose the subscription is, for msgbus."""


def follow() -> None:
    """Bring the lists of the current scene after its active object. Called by Blender; safe to call at any time."""
    context = bpy.context
    if context.scene is not None and context.view_layer is not None:
        follow_active(context.scene, context.view_layer)


@bpy.app.handlers.persistent
def _after_undo(*_arguments: object) -> None:
    follow()


@bpy.app.handlers.persistent
def _after_load(*_arguments: object) -> None:
    _subscribe()  # loading a file ends all subscriptions


def _subscribe() -> None:
    bpy.msgbus.clear_by_owner(_OWNER)
    bpy.msgbus.subscribe_rna(
        key=(bpy.types.LayerObjects, "active"), owner=_OWNER, args=(), notify=follow, options={"PERSISTENT"}
    )


def _handlers() -> list[tuple[list, object]]:
    at = bpy.app.handlers
    return [(at.undo_post, _after_undo), (at.redo_post, _after_undo), (at.load_post, _after_load)]


def register() -> None:
    for handlers, each in _handlers():
        handlers.append(each)
    _subscribe()


def unregister() -> None:
    bpy.msgbus.clear_by_owner(_OWNER)
    for handlers, each in _handlers():
        if each in handlers:
            handlers.remove(each)
