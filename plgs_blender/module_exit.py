"""Ending a process that uses Blender as a module of Python."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import NoReturn

import bpy


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
