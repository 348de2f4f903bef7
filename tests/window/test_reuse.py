"""Objects of a lift for other uses, by the buttons of 5 Export."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from blender import Window
from shown_lift import CABINET, CHAIR, over, shown_lift

KEYED = """
scene = bpy.context.window_manager.windows[0].scene
box = inspecting.boxes_of(lift())[{number}]
answer = []
for marker in scene.timeline_markers:
    scene.frame_set(marker.frame)
    answer.append((marker.name, not box.hide_viewport))
"""


@pytest.fixture
def mine(window: Window, work_folder: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A lift of its own that is shown, with the panel of exports open."""
    with shown_lift(window, work_folder / request.node.name, "PLGS_PT_export", "Reuse", bake=True) as lift:
        yield lift


def test_objects_are_made_animated_and_undone_in_the_window(window: Window, mine: Path) -> None:
    window.run(f"choose({CHAIR})")
    _, height = window.press("plgs.make_objects")
    made = "sorted(ob.name for ob in bpy.data.objects if ob.name.startswith('chair 1 ') and ' box' not in ob.name)"
    assert window.ask(made) == ["chair 1 points"]
    shown = "[row.instance_id for row in lift().plgs.instances if row.visible]"
    assert window.ask(shown) == [CABINET]
    window.screenshot("reuse-made")
    window.move(*over(window, CABINET))
    window.key("ctrl+z")
    assert window.ask(made) == [] and sorted(window.ask(shown)) == sorted([CHAIR, CABINET])
    window.run(f"choose({CABINET})")
    window.press("plgs.key_visibility", near=height)
    rows = f"{{mask.frame for row in lift().plgs.instances if row.instance_id == {CABINET} for mask in row.masks}}"
    masked, seen = set(window.ask(rows)), dict(window.run(KEYED.format(number=CABINET)))
    assert masked and all(visible == (name in masked) for name, visible in seen.items() if name != "Overview")
