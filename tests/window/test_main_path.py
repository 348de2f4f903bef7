"""From a folder of frames to a box in the view, with mouse and keys as a user has them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from blender import Window

if str(Path(__file__).parent.parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent.parent))

from tiny_scene import write_tiny_scene  # noqa: E402  (beside this folder)

STEPS = 600
LIFTS = "__import__('sys').modules[EXTENSION + '.plgs_blender.running.lifts']"


@pytest.fixture(scope="module")
def scene(work_folder: Path) -> Path:
    return write_tiny_scene(work_folder / "tiny")


def choose_scene(window: Window, scene: Path) -> None:
    """Type the folder into its field."""
    window.click(*window.find_field("plgs.scene_folder"))
    window.key("ctrl+a")
    window.type(str(scene))
    window.key("Return")
    window.settle()
    assert window.ask("bpy.context.scene.plgs.scene_folder").rstrip("/") == str(scene)


def test_cameras_are_imported(window: Window, scene: Path) -> None:
    window.open_sidebar()
    choose_scene(window, scene)
    window.screenshot("scene")
    window.press("plgs.import_scene")
    window.settle()
    window.screenshot("imported")
    assert window.ask("sum(each.type == 'CAMERA' for each in bpy.context.scene.objects)") == 1 + 6


def test_a_lift_is_started_cancelled_resumed_and_its_box_picked(window: Window, scene: Path) -> None:
    window.open_sidebar()
    choose_scene(window, scene)
    window.run(f"bpy.context.scene.plgs.steps = {STEPS}")
    window.wait_for_kernels()
    window.press("plgs.lift_scene")
    window.wait_for(f"bool({LIFTS}.running())")
    window.wait_for(f"{LIFTS}.running()[0].status.step > 20 and {LIFTS}.running()[0].status.steps == {STEPS}", 120)
    window.screenshot("lifting")
    window.press("plgs.cancel_lift")
    window.wait_for(f"not {LIFTS}.running()")
    window.settle()
    window.screenshot("cancelled")
    window.press("plgs.resume_lift")
    window.wait_for(f"bool({LIFTS}.running())")
    window.wait_for(f"not {LIFTS}.running()", 180)
    window.settle()
    window.screenshot("finished")
    print(window.waits(), window.longest_gap())
    assert window.longest_wait() < 0.05
