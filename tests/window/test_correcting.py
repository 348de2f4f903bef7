"""Mending a lift with the mouse: the panel's buttons, painting, a plane that is dragged, and Ctrl Z."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from blender import Window
from shown_lift import CABINET, CHAIR, over, shown_lift

OK_BELOW = 40
"""Pixels from a dialog's only field, which opens under the mouse, down to its OK."""


@pytest.fixture
def mine(window: Window, work_folder: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A lift of its own that is shown, with its panel open."""
    with shown_lift(window, work_folder / request.node.name, "PLGS_PT_corrections", "Correct") as lift:
        yield lift


def kinds(lift: Path) -> list[str]:
    """The edits that are not undone."""
    edits = json.loads((lift / "corrections.json").read_text())["edits"]
    return [edit["kind"] for edit in edits if not edit.get("undone")]


def test_points_are_painted_with_the_mouse(window: Window, mine: Path) -> None:
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


@pytest.mark.slow
def test_an_objects_class_is_changed_by_typing_its_name(window: Window, mine: Path) -> None:
    window.run(f"choose({CHAIR})")
    at, height = window.press("plgs.reclass_instances")
    window.settle()
    window.type("cab")
    window.settle()
    window.screenshot("correcting-class")
    window.key("Down", "Return")  # the first class
    window.settle()
    window.click(at, height + OK_BELOW)
    kind = f"next(row.class_name for row in lift().plgs.instances if row.instance_id == {CHAIR})"
    assert window.ask(kind) == "cabinet" and kinds(mine) == ["reclass"]
    x, y = over(window, CABINET)
    window.move(x, y)
    window.key("ctrl+z")
    assert window.ask(kind) == "chair" and kinds(mine) == []


def test_objects_of_an_opened_file_are_read_automatically(window: Window, mine: Path) -> None:
    saved = str(mine / "lift.blend")
    window.run(f"bpy.ops.wm.save_as_mainfile(filepath={saved!r})")
    window.run("lists = sys.modules[EXTENSION + '.plgs_blender.results']; lists._kept.clear()")
    window.run(f"bpy.ops.wm.open_mainfile(filepath={saved!r})")
    window.wait_for("len(lists._kept) == 1 and not lists._begun")
