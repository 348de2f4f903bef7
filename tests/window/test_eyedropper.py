"""The Cryptomatte eyedropper of the passes' compositor, with the mouse."""

from __future__ import annotations

from pathlib import Path

import tiny_lift
from blender import SIZE, Window
from tiny_scene import tiny_intrinsics, tiny_pose, trace_view

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


def test_it_selects_the_instance_under_the_mouse(window: Window, work_folder: Path) -> None:
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
