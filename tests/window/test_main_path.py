"""From a folder of frames to a box in the view, with mouse and keys as a user has them."""

from __future__ import annotations

from pathlib import Path

import pytest
from blender import SIZE, Window
from tiny_scene import write_tiny_scene

STEPS = 400
LIFTS = "__import__('sys').modules[EXTENSION + '.plgs_blender.running.lifts']"
RUNNING = f"{LIFTS}.registry.running({LIFTS}.Lift)"
LIFT = "__import__('pathlib').Path(bpy.context.scene.plgs.lift_folder)"
# A pixel of the screen where each object is seen, near its box's middle: points leave gaps.
BOXES = f"""
import sys
from bpy_extras.view3d_utils import location_3d_to_region_2d
picking = next(each for name, each in sys.modules.items() if name.endswith('.plgs_blender.inspecting.picking'))
area = next(each for each in bpy.context.window.screen.areas if each.type == 'VIEW_3D')
region = next(each for each in area.regions if each.type == 'WINDOW')
answer = {{}}
for each in bpy.context.scene.objects:
    kind, _, number = each.get('plgs_key', '').partition(':')
    if kind == 'instance':
        x, y = location_3d_to_region_2d(region, area.spaces.active.region_3d, each.matrix_world.translation)
        with bpy.context.temp_override(area=area, region=region):
            for step in range(0, 200, 4):
                for at in ((x + step, y), (x - step, y), (x, y + step), (x, y - step)):
                    found = picking.what_is_under(bpy.context, at)
                    if each.name not in answer and found is not None and found.instance == int(number):
                        answer[each.name] = round(region.x + at[0]), {SIZE[1]} - round(region.y + at[1])
"""


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


def test_cameras_are_imported_in_the_window(window: Window, scene: Path) -> None:
    window.open_sidebar()
    choose_scene(window, scene)
    window.screenshot("scene")
    window.press("plgs.import_scene")
    window.settle()
    window.screenshot("imported")
    assert window.ask("sum(each.type == 'CAMERA' for each in bpy.context.scene.objects)") == 1 + 6 + 1


def test_a_lift_is_started_cancelled_and_resumed_and_its_box_picked(window: Window, scene: Path) -> None:
    window.open_sidebar()
    choose_scene(window, scene)
    window.run(f"bpy.context.scene.plgs.steps = {STEPS}; bpy.context.scene.plgs.preset_options = 'warm_start=false'")
    _, start = window.press("plgs.lift_scene")
    window.wait_for(f"{RUNNING} and {RUNNING}[0].progress.steps == {STEPS} and {RUNNING}[0].progress.step > 20")
    with window.suspended(Path(window.ask("bpy.context.scene.plgs.lift_folder"))):
        window.screenshot("lifting")
        _, cancel = window.press("plgs.cancel_lift", near=start + 50)
    window.wait_for(f"not {RUNNING}")
    window.settle()
    window.screenshot("cancelled")
    assert 20 < window.ask(f"{LIFTS}.lift_of({LIFT}).progress.step") < STEPS
    window.press("plgs.resume_lift", near=cancel)
    window.wait_for(f"bool({RUNNING})")
    window.wait_for(f"not {RUNNING} and {LIFTS}.lift_of({LIFT}).is_taken")  # the last that is placed turns the view
    window.settle()
    window.screenshot("finished")
    assert window.ask(f"{LIFTS}.lift_of({LIFT}).is_finished")

    # The view shows the room as it opened, with nothing in the way.
    boxes = window.run(BOXES)
    assert sorted(name.split()[0] for name in boxes) == ["cabinet", "chair"]
    for name, spot in boxes.items():
        window.click(*spot)
        window.settle()
        window.screenshot(f"picked-{name}")
        assert window.ask("bpy.context.view_layer.objects.active.name") == name
