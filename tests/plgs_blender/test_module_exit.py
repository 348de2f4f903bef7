"""A script with Blender as a module ends, whatever still refers to bpy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from plgs_blender.lifecycle import drop_session_folder

LEFT_OVER = """
import ctypes, sys, bpy
ctypes.pythonapi.Py_IncRef(ctypes.py_object(bpy))
from plgs_blender.lifecycle import end_process
print(bpy.app.tempdir)
end_process(3)
"""


def test_a_leftover_reference_does_not_delay_the_end(root: Path) -> None:
    said = subprocess.run([sys.executable, "-c", LEFT_OVER], cwd=root, capture_output=True, text=True, timeout=60)
    assert said.returncode == 3, said.stderr
    folder = Path(said.stdout.splitlines()[-1])
    assert folder.is_absolute() and not folder.exists()


def test_only_the_folder_of_the_session_is_deleted(tmp_path: Path) -> None:
    session, shared = tmp_path / "blender_a1b2", tmp_path / "all"
    for folder in (session, shared):
        folder.mkdir()
        (folder / "file").touch()
        drop_session_folder(folder)
    assert not session.exists() and (shared / "file").exists()
