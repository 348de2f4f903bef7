"""The end of a script for which Blender is a module of Python, and not the program."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import NoReturn

import bpy


def end_process(code: int) -> NoReturn:
    """End with this exit code. Within Blender's own program as ever.

    As a module Blender is closed with the last reference to bpy. Where one is left over, as by a traceback, C++'s
    destructors run instead, and that of Blender's sound waits for ever: so they are not run.
    """
    if bpy.app.binary_path:
        sys.exit(code)
    drop_session_folder(Path(bpy.app.tempdir))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def drop_session_folder(folder: Path) -> None:
    """Delete Blender's folder for temporary files of this session, as it does itself where it is closed. Where it could
    make none, ``folder`` is that of all programs, and stays."""
    if folder.name.startswith("blender_"):
        shutil.rmtree(folder, ignore_errors=True)
