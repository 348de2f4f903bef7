"""What is wrong with a capture, in the window: a finding's picture opens beside the view, its frames are links."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from blender import Window

from tests.tiny_scene import write_tiny_scene

EDITORS = "[a.spaces.active.image.name for a in bpy.context.screen.areas if a.type == 'IMAGE_EDITOR']"
MEASURED = """
import sys
diagnosis = sys.modules[EXTENSION + '.plgs_blender.running.diagnosis']
known = lambda: diagnosis.registry.latest(diagnosis.Diagnosis)
"""


@pytest.fixture(scope="module")
def dark(work_folder: Path) -> tuple[Path, str]:
    """A scene with one black photo, and that frame's name."""
    scene = write_tiny_scene(work_folder / "dark room", frames=14, size=(96, 72))
    photo = sorted((scene / "color").iterdir())[6]
    cv2.imwrite(str(photo), np.zeros((72, 96, 3), np.uint8))
    return scene, photo.stem


def test_a_finding_is_a_picture_and_buttons(window: Window, dark: tuple[Path, str]) -> None:
    scene, frame = dark
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(scene)!r}")
    window.press("plgs.import_scene")
    window.wait_for("'Camera path' in bpy.context.scene.objects")
    window.run(MEASURED + "bpy.ops.plgs.diagnose('INVOKE_DEFAULT')")
    window.wait_for("known() is not None and not known().is_running and known().is_taken")
    assert window.ask("known().error") is None
    number = window.ask("next(n for n, each in enumerate(known().findings) if each.frames)")
    window.run(f"bpy.ops.plgs.show_finding(number={number})")
    window.settle()
    assert window.ask(EDITORS) != [], "it opens beside the view, which had no image editor"
    window.run(f"bpy.ops.plgs.go_to_finding(number={number}, frame={frame!r})")
    assert window.ask("bpy.context.scene.camera['frame']") == frame
    window.screenshot("findings")
    window.run(f"bpy.ops.plgs.leave_out(number={number})")
    assert frame not in (scene / "splits.json").read_text()
