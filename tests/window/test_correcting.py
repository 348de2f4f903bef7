"""Mending a lift with the mouse: the panel's buttons, painting, a plane that is dragged, and Ctrl Z."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from blender import SIZE, Window

for folder in (Path(__file__).parents[1] / "plgs_blender", Path(__file__).parents[1]):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

import tiny_lift  # noqa: E402  (beside the tests of plgs_blender)

CHAIR, CABINET = 1, 2
# The panel in a tab of its own, open: nothing in Python opens a closed panel.
OWN_TAB = """
panel = bpy.types.PLGS_PT_corrections
bpy.utils.unregister_class(panel)
kept = panel.bl_options, panel.bl_parent_id, panel.bl_category
panel.bl_options, panel.bl_category = set(), 'Correct'
panel.bl_parent_id = ''
bpy.utils.register_class(panel)
"""
BACK = """
bpy.utils.unregister_class(panel)
panel.bl_options, panel.bl_parent_id, panel.bl_category = kept
bpy.utils.register_class(panel)
"""
TOOLS = """
import sys
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
inspecting = sys.modules[EXTENSION + '.plgs_blender.inspecting.lookup']

def lift():
    return inspecting.active_lift(bpy.context.window_manager.windows[0].scene, None)

def points(number):
    clouds = [each for each in inspecting.clouds_of(lift()) if 'class_id' in each]
    return sum(int((inspecting.ids_of(each.data, 'instance_id') == number).sum()) for each in clouds)

def ids():
    return sorted(row.instance_id for row in lift().plgs.instances)

def place(number):
    window = bpy.context.window_manager.windows[0]
    area = max((each for each in window.screen.areas if each.type == 'VIEW_3D'), key=lambda each: each.width)
    region = next(each for each in area.regions if each.type == 'WINDOW')
    box = inspecting.boxes_of(lift())[number]
    at = location_3d_to_region_2d(region, area.spaces.active.region_3d, box.matrix_world.translation)
    return round(region.x + at.x), round(region.y + at.y)

def sidebar():
    areas = bpy.context.window_manager.windows[0].screen.areas
    area = max((each for each in areas if each.type == 'VIEW_3D'), key=lambda each: each.width)
    return next(each for each in area.regions if each.type == 'UI')

def choose(*numbers):
    for key, box in inspecting.boxes_of(lift()).items():
        box.select_set(key in numbers)
    bpy.context.view_layer.objects.active = inspecting.boxes_of(lift())[numbers[0]]
    lift().plgs.instance_index = next(i for i, row in enumerate(lift().plgs.instances) if row.instance_id == numbers[0])
"""


@pytest.fixture
def mine(window: Window, work_folder: Path, request: pytest.FixtureRequest) -> Path:
    """A lift of its own that is shown, with its panel open."""
    lift = tiny_lift.write_tiny_lift(work_folder / request.node.name / "lift", bake=False).path
    window.run(OWN_TAB)
    request.addfinalizer(lambda: window.run(BACK) if window.is_running else None)
    window.run(f"bpy.ops.plgs.place_lift(lift_folder={str(lift)!r})")
    window.run(TOOLS)
    window.run("bpy.ops.ed.undo_push(message='shown')")
    window.open_sidebar("Correct")
    window.settle()
    return lift


def kinds(lift: Path) -> list[str]:
    """The edits that are not undone."""
    edits = json.loads((lift / "corrections.json").read_text())["edits"]
    return [edit["kind"] for edit in edits if not edit.get("undone")]


def over(window: Window, number: int) -> tuple[int, int]:
    """Where an object's middle is on the screen."""
    x, y = window.ask(f"place({number})")
    return x, SIZE[1] - y


def test_merged_split_by_views_and_undone(window: Window, mine: Path) -> None:
    before = window.ask("points(1), points(2)")
    window.run(f"choose({CABINET}, {CHAIR})")
    window.press("plgs.merge_instances")
    assert window.ask("ids()") == [CABINET] and window.ask(f"points({CABINET})") == sum(before)
    _, height = window.press("plgs.split_by_views")
    window.wait_for("len(ids()) == 2", timeout=120)
    window.settle()
    window.screenshot("correcting-split")
    assert kinds(mine) == ["merge", "split"]
    window.move(*over(window, CABINET))
    window.key("ctrl+z")
    assert window.ask("ids()") == [CABINET] and kinds(mine) == ["merge"]
    window.key("ctrl+shift+z")
    assert len(window.ask("ids()")) == 2 and kinds(mine) == ["merge", "split"]
    window.press("plgs.undo_correction", near=height)
    window.press("plgs.undo_correction", near=height)
    assert kinds(mine) == [] and window.ask("points(1), points(2)") == before


def test_points_are_painted(window: Window, mine: Path) -> None:
    before = window.ask("points(1), points(2)")
    window.run(f"choose({CHAIR})")
    x, y = over(window, CABINET)
    _, height = window.press("plgs.assign_points", contains="INSTANCE")
    window.drag((x - 30, y), (x + 30, y))
    window.settle()
    window.screenshot("correcting-painted")
    assert window.ask("points(1), points(2)") == before  # nothing before Enter
    window.key("Return")
    chair, cabinet = window.ask("points(1), points(2)")
    assert chair - before[0] > 100 and cabinet < before[1] and kinds(mine) == ["assign"]
    window.move(x, y)
    window.key("ctrl+z")
    assert window.ask("points(1), points(2)") == before and kinds(mine) == []
    window.press("plgs.assign_points", near=height)
    window.drag((x - 30, y), (x + 30, y))
    window.key("Escape")
    assert kinds(mine) == []


def test_points_in_a_rectangle_become_a_new_object(window: Window, mine: Path) -> None:
    window.run(f"choose({CHAIR})")
    x, y = over(window, CABINET)
    left, height = window.find_button("plgs.assign_points")
    window.click(left + window.ask("sidebar().width // 3"), height)  # the menu beside it
    window.settle()
    window.key("Down", "Return")
    window.drag((x - 30, y - 30), (x + 30, y + 30), "shift")
    window.key("Return")
    assert window.ask("ids()") == [CHAIR, CABINET, 3] and window.ask("points(3)") > 0 and kinds(mine) == ["assign"]


def test_a_plane_a_box_a_class_and_no_object(window: Window, mine: Path) -> None:
    whole = window.ask(f"points({CABINET})")
    window.run(f"choose({CABINET})")
    window.press("plgs.place_cut")
    _, height = window.press("plgs.split_instance", contains="CUT")
    assert window.ask("ids()") == [CHAIR, CABINET, 3]
    assert window.ask(f"points({CABINET}) + points(3)") == whole
    window.run(f"choose({CABINET})")
    x, y = over(window, CABINET)
    window.move(x, y)
    window.key("s", "z", "0", "period", "5", "Return")  # scaled by hand
    window.press("plgs.crop_instance", near=height)
    assert 0 < window.ask(f"points({CABINET})") < whole and kinds(mine) == ["split", "assign"]
    window.press("plgs.accept_instances", near=height)
    window.run("choose(3)")
    window.press("plgs.delete_instance", near=height)
    assert window.ask("ids()") == [CHAIR, CABINET] and kinds(mine) == ["split", "assign", "accept", "delete"]
