"""A capture whose pictures no image file shows: imported with a button, completed by an engine in the background."""

from __future__ import annotations

from pathlib import Path

import pytest
from blender import Window

from tests.scene.formats.test_scannet import sens

MODULES = """
import sys
registry = sys.modules[EXTENSION + '.plgs_blender.registry']
making = lambda: registry.latest(sys.modules[EXTENSION + '.plgs_blender.running.importing'].FrameMaking)
"""
PICTURES = "sum(len(each.data.background_images) for each in bpy.context.scene.objects if 'frame' in each)"
SHOWN = "bpy.context.scene.camera.data.background_images[0].image.name"


@pytest.fixture(scope="module")
def archive(work_folder: Path) -> Path:
    (work_folder / "scans").mkdir()
    path = work_folder / "scans" / "office.sens"
    path.write_bytes(sens())
    return path


def test_the_engine_adds_pictures_and_a_cloud_while_the_window_keeps_working(window: Window, archive: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(archive)!r}")
    window.press("plgs.import_scene")
    window.wait_for("'Camera path' in bpy.context.scene.objects")
    window.wait_for(f"{PICTURES} == 6")
    window.run(MODULES)
    window.wait_for("'Coloured cloud' in bpy.context.scene.objects and not making().is_running")
    assert window.ask("making().error") is None
    window.settle()
    window.screenshot("capture")


@pytest.mark.slow
def test_depth_is_shown_and_undone(window: Window, archive: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(archive)!r}")
    window.press("plgs.import_scene")
    window.wait_for(f"{PICTURES} == 6")
    window.run("bpy.context.scene.camera = next(each for each in bpy.context.scene.objects if 'frame' in each)")
    window.run("bpy.ops.ed.undo_push(message='chosen')")
    window.settle()
    window.press("plgs.show_picture", contains="DEPTH")
    window.wait_for(f"{SHOWN}.startswith('Depth')")
    window.settle()
    window.screenshot("depth")
    window.run("bpy.ops.ed.undo()")
    assert window.ask(f"{SHOWN}.startswith('Depth')") is False
    window.run("bpy.ops.ed.undo(); bpy.ops.ed.undo()")
    assert window.is_running
