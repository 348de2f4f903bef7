"""Passes in a window: baking a camera over a long range, the compositor, and Cryptomatte's eyedropper."""

from __future__ import annotations

from pathlib import Path

import pytest
import tiny_lift
from blender import SIZE, Window
from tiny_scene import tiny_intrinsics, tiny_pose, trace_view

from tests.waiting import wait_until

SHOWN = """
editors = [each for each in bpy.context.window.screen.areas if each.ui_type == 'CompositorNodeTree']
space = editors[0].spaces.active
answer = [bpy.context.window.scene.name, bpy.context.window.workspace.name, space.show_backdrop,
          space.edit_tree.nodes.active.get('plgs_key')]
"""
STATUS_BAR = 20
"""Its height in pixels."""
READING = "'PLGS_OT_bake_camera' in [each.bl_idname for each in bpy.context.window_manager.windows[0].modal_operators]"
EYE = """
space = next(a for a in bpy.data.workspaces['Layout'].screens[0].areas if a.type == 'VIEW_3D').spaces.active
answer = space.region_3d.view_perspective, bpy.context.window.scene.camera.name
"""
PRESS = """
with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
    bpy.ops.plgs.bake_camera('INVOKE_DEFAULT', lift_folder={lift!r})
"""


def test_one_button_opens_the_passes_in_the_compositor(window: Window, work_folder: Path) -> None:
    lift = tiny_lift.write_tiny_lift(work_folder / "compositor" / "lift")
    window.place(lift.path)
    window.run(f"bpy.context.scene.plgs.lift_folder = {str(lift.path)!r}")
    window.open_sidebar()
    window.run("bpy.ops.plgs.go_to_frame(frame='0001')")
    window.settle()
    window.screenshot("panel-of-passes")
    window.run("bpy.ops.plgs.show_passes()")
    window.settle()
    window.screenshot("compositor")
    assert window.run(SHOWN) == ["PLGS tiny room passes", "Compositing", True, "panoptic"]
    place = "[bpy.context.window.scene.name, bpy.context.window.workspace.name]"
    for workspace, scene in (("Layout", "Scene"), ("Compositing", "PLGS tiny room passes")):
        window.run(f"bpy.context.window.workspace = bpy.data.workspaces[{workspace!r}]")  # as its tab does
        window.settle()
        assert window.ask(place) == [scene, workspace]
        assert workspace != "Layout" or window.run(EYE) == ["CAMERA", "0001"]
    window.run("bpy.ops.plgs.show_room()")
    window.settle()
    window.screenshot("back-in-the-room")
    assert window.ask(place) == ["Scene", "Layout"] and window.run(EYE) == ["CAMERA", "0001"]
    window.run("bpy.context.window.workspace = bpy.data.workspaces['Compositing']")
    window.settle()
    assert window.ask(place) == ["Scene", "Compositing"], "the user's own nodes, until the passes are asked for again"


@pytest.mark.slow
def test_the_window_responds_while_a_long_range_is_read_and_esc_stops_it(window: Window, work_folder: Path) -> None:
    lift = tiny_lift.write_tiny_lift(work_folder / "long range" / "lift")
    window.place(lift.path)
    window.run("scene = bpy.context.scene; scene.frame_start, scene.frame_end = 1, 300000; scene.frame_set(7)")
    window.settle()
    status_bar = window.picture()[-STATUS_BAR:]
    window.run("watch.begin()")
    window.run(PRESS.format(lift=str(lift.path)))
    window.wait_for(READING)
    wait_until(lambda: (window.picture()[-STATUS_BAR:] != status_bar).any(), "frames counted in the status bar")
    window.screenshot("reading-a-camera")
    assert window.ask(f"{READING} and scene.frame_current == 7")
    window.key("Escape")
    window.wait_for(f"not {READING}")
    assert any(call.startswith("base.py") for call in window.waits())
    assert not [call for call in window.slow_calls(0.1).items() if call[0].startswith("base.py")]
    assert not list((lift.path / "bake").glob("*.json"))


ZOOM = 8
NODE = "__import__('sys').modules[EXTENSION + '.plgs_blender.pass_nodes'].node_of(tree, 'CryptoInstance')"
# The largest area becomes a node editor before the picture of the passes, with the node of the instances' matte active.
SHOW = f"""
manager = bpy.context.window_manager.windows[0]
passes = next(each for each in bpy.data.scenes if each.name.endswith(' passes'))
manager.scene = passes
area = max(manager.screen.areas, key=lambda each: each.width * each.height)
area.ui_type = 'CompositorNodeTree'
space = area.spaces.active
space.show_backdrop, space.backdrop_zoom, space.show_region_ui = True, {ZOOM}, True
tree = getattr(passes, 'compositing_node_group', None) or passes.node_tree
for each in tree.nodes:
    each.select = False
node = {NODE}
node.matte_id, node.select, tree.nodes.active = '', True, node
"""


def test_a_click_in_a_pass_selects_the_instance_under_the_mouse(window: Window, work_folder: Path) -> None:
    lift = tiny_lift.write_tiny_lift(work_folder / "eyedropper" / "lift")
    window.place(lift.path, then=SHOW)
    window.space = "NODE_EDITOR"
    window.settle()
    window.open_sidebar("Node")
    window.settle()
    window.screenshot("eyedropper-before")
    window.press("ui.eyedropper_color")
    name = window.ask("passes.timeline_markers[passes.frame_current - 1].name")
    window.click(*spot_of(window, 1, name))
    window.settle()
    window.screenshot("eyedropper-picked")
    assert window.ask("node.matte_id") == tiny_lift.CHAIR_NAME


def spot_of(window: Window, instance: int, view: str) -> tuple[int, int]:
    """Where on the screen an instance's middle is, in the backdrop's picture."""
    size = (64, 48)
    seen = trace_view(tiny_pose(int(view), tiny_lift.FRAMES), tiny_intrinsics(size), size).instance == instance
    rows, columns = seen.nonzero()
    left, top, width, height = window.run(
        "region = next(each for each in area.regions if each.type == 'WINDOW')\n"
        f"answer = region.x, {SIZE[1]} - region.y - region.height, region.width, region.height"
    )
    x = left + width / 2 + (columns.mean() + 0.5 - size[0] / 2) * ZOOM
    y = top + height / 2 + (rows.mean() + 0.5 - size[1] / 2) * ZOOM
    return round(x), round(y)
