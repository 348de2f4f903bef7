"""Switching modules on and off. Each lists its `CLASSES` and may have a `register` and `unregister` of its own."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import bpy


def register_modules(modules: Sequence[ModuleType]) -> None:
    """Register each module's classes, then call its `register` where it has one.

    Properties on Blender's types, handlers, timers and draw handlers are up to each module.
    """
    for module in modules:
        for each in getattr(module, "CLASSES", ()):
            bpy.utils.register_class(each)
        if hasattr(module, "register"):
            module.register()


def unregister_modules(modules: Sequence[ModuleType]) -> None:
    """Undo `register_modules` in reverse order, so that nothing refers to a class that goes."""
    for module in reversed(modules):
        if hasattr(module, "unregister"):
            module.unregister()
        for each in reversed(getattr(module, "CLASSES", ())):
            bpy.utils.unregister_class(each)
