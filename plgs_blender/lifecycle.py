"""Switching modules on and off, and ending a process. Each module lists its `CLASSES` and may have a `register` and
`unregister` of its own.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn

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


def end_process(code: int) -> NoReturn:
    """End with this exit code, as `sys.exit` does within Blender's own program.

    As a module, Blender is closed with the last reference to bpy. A reference that is left over, as by a traceback,
    leaves it open. Then C++'s destructors run, and that of Blender's sound waits forever, so we skip them.
    """
    if bpy.app.binary_path:
        sys.exit(code)
    drop_session_folder(Path(bpy.app.tempdir))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def drop_session_folder(folder: Path) -> None:
    """Delete Blender's folder for temporary files of this session, as closing Blender does. When Blender could not make
    one, ``folder`` is that of all programs, and stays.
    """
    if folder.name.startswith("blender_"):
        shutil.rmtree(folder, ignore_errors=True)
