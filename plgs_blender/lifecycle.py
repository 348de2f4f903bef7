"""Register and unregister modules, and end a process. A module may list:

- `CLASSES`;
- `PROPERTIES`: (type of bpy.types, name, property group), such as (bpy.types.Scene, "plgs", PLGS_PG_settings);
- `MENUS`: (name of a menu or header, "append" or "prepend", draw function);
- `HANDLERS`: (name in bpy.app.handlers, function).

A module may also have a `register` and an `unregister` of its own."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import bpy


def list_classes(modules: Sequence[ModuleType]) -> None:
    """Set each module's `CLASSES` to the classes in it whose names begin with PLGS_, in order."""
    for module in modules:
        vars(module)["CLASSES"] = [each for name, each in vars(module).items() if name.startswith("PLGS_")]


def register_modules(modules: Sequence[ModuleType]) -> None:
    """Register what each module lists, then call its `register`, if any."""
    for module in modules:
        for each in getattr(module, "CLASSES", ()):
            bpy.utils.register_class(each)
        for owner, name, group in getattr(module, "PROPERTIES", ()):
            setattr(owner, name, bpy.props.PointerProperty(type=group))
        for name, way, draw in getattr(module, "MENUS", ()):
            getattr(getattr(bpy.types, name), way)(draw)
        for name, handler in getattr(module, "HANDLERS", ()):
            getattr(bpy.app.handlers, name).append(handler)
        if hasattr(module, "register"):
            module.register()


def unregister_modules(modules: Sequence[ModuleType]) -> None:
    """Unregister what `register_modules` registered, in reverse order, so that nothing refers to a removed class."""
    for module in reversed(modules):
        if hasattr(module, "unregister"):
            module.unregister()
        for name, handler in getattr(module, "HANDLERS", ()):
            if handler in getattr(bpy.app.handlers, name):
                getattr(bpy.app.handlers, name).remove(handler)
        for name, _, draw in getattr(module, "MENUS", ()):
            getattr(bpy.types, name).remove(draw)
        for owner, name, _ in getattr(module, "PROPERTIES", ()):
            delattr(owner, name)
        for each in reversed(getattr(module, "CLASSES", ())):
            bpy.utils.unregister_class(each)


def end_process(code: int) -> NoReturn:
    """End with this exit code, as `sys.exit` does within Blender's own program. As a Python module, Blender closes with
    the last reference to bpy. A leftover reference, such as a traceback's, keeps it open until C++'s destructors run,
    and that of Blender's sound never returns, so we skip them."""
    if bpy.app.binary_path:
        sys.exit(code)
    drop_session_folder(Path(bpy.app.tempdir))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def drop_session_folder(folder: Path) -> None:
    """Delete this session's temporary folder, as Blender does when it closes. If Blender could not make one, ``folder``
    is shared by all programs and stays."""
    if folder.name.startswith("blender_"):
        shutil.rmtree(folder, ignore_errors=True)
