"""A click selects what is seen, and keys, menus and the search act on it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from blender import SIZE, Window
from shown_lift import CABINET, CHAIR, over, shown_lift, upon

ACTIVE = "bpy.context.view_layer.objects.active"
CHOSEN = f"[lift().plgs.instances[lift().plgs.instance_index].instance_id, inspecting.instance_of({ACTIVE})]"
SELECTED = "sorted(inspecting.instance_of(each) for each in bpy.context.selected_objects)"
FIRST_ROW = 57
"""Pixels from the field for a search down to the list's first row."""
NAMES = "[row.name for row in lift().plgs.instances]"


@pytest.fixture
def mine(window: Window, work_folder: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    with shown_lift(window, work_folder / request.node.name, "PLGS_PT_corrections", "Correct") as lift:
        window.run("bpy.ops.object.select_all(action='DESELECT')")
        yield lift


def kinds(lift: Path) -> list[str]:
    """The edits that are not undone."""
    path = lift / "corrections.json"
    edits = json.loads(path.read_text())["edits"] if path.exists() else []
    return [edit["kind"] for edit in edits if not edit.get("undone")]


def test_a_click_selects_the_object_under_the_mouse(window: Window, mine: Path) -> None:
    for number in (CHAIR, CABINET, CHAIR):
        window.click(*upon(window, number))
        window.settle()
        assert window.ask(CHOSEN) == [number, number] and window.ask(SELECTED) == [number]
    window.screenshot("pointing-selected")
    x, y = upon(window, CABINET)
    window.move(x, y)
    window._input("keydown", "shift")
    window.click(x, y)
    window._input("keyup", "shift")
    window.settle()
    assert window.ask(SELECTED) == [CHAIR, CABINET]
    window.run("bpy.ops.mesh.primitive_monkey_add(size=0.5, location=boxes()[2].matrix_world.translation)")
    window.run(f"{ACTIVE}.location.z += 1.0; bpy.context.view_layer.update()\nanswer = {ACTIVE}.name")
    window.run("choose(1)")
    window.settle()
    at = window.run("at = bpy.data.objects['Suzanne'].location\nboxes_place = place_of(at)\nanswer = boxes_place")
    window.click(at[0], SIZE[1] - at[1])
    window.settle()
    window.screenshot("pointing-suzanne")
    assert window.ask(f"{ACTIVE}.name") == "Suzanne", "the user's own things stay selectable"
    window.run("choose(1)")
    window._input("keydown", "shift")
    window.click(at[0], SIZE[1] - at[1])
    window._input("keyup", "shift")
    window.settle()
    assert window.ask(f"{ACTIVE}.name") == "Suzanne" and window.ask(SELECTED) == [0, CHAIR], "and Shift adds them"


def test_a_click_on_the_floor_selects_no_object(window: Window, mine: Path) -> None:
    chosen = "[lift().plgs.instance_index, bpy.ops.plgs.delete_selected.poll()]"
    for _ in range(2):
        window.click(*upon(window, CHAIR))
        window.settle()
        assert window.ask(SELECTED) == [CHAIR] and window.ask("lift().plgs.instance_index") == 0
        window.click(*upon(window, 0))
        window.settle()
        window.screenshot("pointing-floor")
        assert window.ask(SELECTED) == [] and window.ask(f"{ACTIVE} is None")
        assert window.ask(chosen) == [-1, False]
    window.click(*over(window, CHAIR))
    window.key("alt+a")  # Blender's own, of which the extension learns a moment later
    window.wait_for("lift().plgs.instance_index == -1")
    assert window.ask("all(box.hide_get() for box in boxes().values())"), "only the selected one has a box"


def test_keys_act_on_the_object_that_was_clicked(window: Window, mine: Path) -> None:
    x, y = over(window, CHAIR)
    window.click(x, y)
    window.key("F2")
    window.settle()
    window.screenshot("pointing-rename")
    window.key("ctrl+a")
    window.type("throne")
    window.key("Return")
    window.settle()
    assert "throne" in window.ask(NAMES) and window.ask(f"boxes()[{CHAIR}].name") == "throne box"
    assert kinds(mine) == ["rename"]
    window.run(f"boxes()[{CHAIR}].name = 'stool'")  # as the outliner does
    window.wait_for("'stool' in [row.name for row in lift().plgs.instances]")
    assert kinds(mine) == ["rename", "rename"]
    window.click(x, y)
    window.key("x")
    window.settle()
    window.screenshot("pointing-x")
    window.key("h")
    window.settle()
    assert window.ask("[row.visible for row in lift().plgs.instances]") == [False, True]
    window.key("ctrl+z")
    window.settle()
    window.click(x, y)
    window.key("x")
    window.settle()
    window.key("d")
    window.settle()
    assert window.ask("ids()") == [CABINET] and kinds(mine) == ["rename", "rename", "delete"]
    window.key("ctrl+z")
    window.settle()
    assert window.ask("ids()") == [CHAIR, CABINET] and kinds(mine) == ["rename", "rename"]


@pytest.mark.slow
def test_a_new_cutting_plane_is_selected_with_the_move_tool(window: Window, mine: Path) -> None:
    window.click(*upon(window, CABINET))
    window.settle()
    window.press("plgs.place_cut")
    window.settle()
    window.screenshot("pointing-cut")
    assert window.ask(f"{ACTIVE}.name, {ACTIVE}.select_get(), {ACTIVE}.show_in_front") == ["Cut", True, True]
    shown = "next(a for a in bpy.context.window.screen.areas if a.type == 'VIEW_3D').spaces.active"
    assert window.ask(f"{shown}.show_gizmo_object_translate")
    window.press("plgs.split_instance", contains="CUT")
    window.settle()
    assert kinds(mine) == ["split"] and not window.ask(f"{shown}.show_gizmo_object_translate")


def test_the_extensions_keys_are_in_blenders_preferences(window: Window) -> None:
    keys = "bpy.context.window_manager.keyconfigs.user.keymaps['Object Mode'].keymap_items"
    found = window.ask(f"sorted({{each.idname for each in {keys} if each.idname.startswith('plgs.')}})")
    assert found == [
        f"plgs.{name}" for name in ("delete_selected", "isolate_selected", "pick", "point_at", "rename_selected")
    ]


def test_a_double_click_in_the_list_renames_an_object(window: Window, work_folder: Path) -> None:
    with shown_lift(window, work_folder / "list", "PLGS_PT_result", "Result") as lift:
        _, y = window.find_field("plgs.instances_search")
        left, _, width, _ = window._region("UI")
        window.move(left + width // 4, y + FIRST_ROW)  # rows are sorted: the cabinet's
        within = "bpy.context.preferences.inputs.mouse_double_click_time"
        usual = window.run(f"answer = {within}; {within} = 1000\nNone")  # ms, for a machine that halts
        window._input("click", "--repeat", "2", "--delay", "60", "1")
        window.settle()
        window.run(f"{within} = {usual}")
        window.key("ctrl+a")
        window.type("seat")
        window.key("Return")
        window.settle()
        window.screenshot("pointing-list")
        assert window.ask(NAMES)[1] == "seat" and window.ask(f"boxes()[{CABINET}].name") == "seat box"
        assert kinds(lift) == ["rename"]
        window.move(*over(window, CABINET))
        window.key("ctrl+z")
        window.settle()
        assert window.ask(NAMES)[1] == "cabinet 1" and kinds(lift) == []
