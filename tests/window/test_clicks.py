"""How often a click means what is drawn under it, on a 9 px grid over four views of a real lift.

    PLGS_WINDOW_TREE=build/blender-trixie .venv/bin/python -m pytest -s tests/window/test_clicks.py

With PLGS_PICTURES_LIFT, a finished lift of another scene with its surface exported, below build, that one is measured.
What Blender draws decides: each instance in a colour of its own, without smoothing, read from the screen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender import SIZE, Window
from shown_lift import large_lift

pytestmark = pytest.mark.slow
RIGHT, WRONG = 0.97, 0.01
"""Least share of the pixels with an instance in front that pick it, and largest share that pick another one."""
STEP = 9
_VIEWS = {"overview": "", "turned": "turn((0, 0, 1), 1.9)", "top": "turned_to((1, 0, 0, 0))", "inside": "enter()"}
_TOOLS = """
import sys
from mathutils import Quaternion
picking, rays = (sys.modules[EXTENSION + '.plgs_blender.inspecting.' + each] for each in ('picking', 'rays'))
lookup = sys.modules[EXTENSION + '.plgs_blender.inspecting.selection']
window = bpy.context.window_manager.windows[0]
area = next(each for each in window.screen.areas if each.type == 'VIEW_3D')
region = next(each for each in area.regions if each.type == 'WINDOW')
view, root = area.spaces.active, lookup.active_lift(window.scene, None)
begin = view.region_3d.view_rotation.copy(), view.region_3d.view_location.copy(), view.region_3d.view_distance

def turn(axis, angle):
    turned_to(Quaternion(axis, angle) @ begin[0])

def turned_to(rotation):
    view.region_3d.view_rotation, view.region_3d.view_location, view.region_3d.view_distance = rotation, *begin[1:]

def enter():
    cameras = sorted((key, ob) for key, ob in lookup.objects_by_key(root).items() if key.startswith('frame:'))
    camera = cameras[len(cameras) // 3][1]
    view.region_3d.view_rotation = camera.matrix_world.to_quaternion()
    view.region_3d.view_location, view.region_3d.view_distance = camera.matrix_world.translation, 0.001

def picked(pixels):
    seen = rays.View.of(view.region_3d, (region.width, region.height), window.scene, view)
    found = [picking.drawn_under([root], seen, (x + 0.5, y + 0.5), view) for x, y in pixels]
    return [0 if each is None else each.instance for each in found]

levels = [each / 255 for each in range(15, 256, 48)]
no_greys = [(r, g, b) for r in levels for g in levels for b in levels if not r == g == b]
for row, colour in zip(root.plgs.instances, no_greys):
    row.colour = colour
root.plgs.show_boxes = root.plgs.show_labels = False
root.plgs.look = 'INSTANCES'
bpy.context.preferences.system.viewport_aa = 'OFF'
view.overlay.show_overlays = view.show_gizmo = view.show_region_toolbar = False
view.show_region_header = view.show_region_tool_header = view.show_region_ui = False
"""


@pytest.fixture(scope="module")
def lift(work_folder: Path) -> Path:
    """The sample's lift with its surface, or the other."""
    return large_lift(work_folder)


@pytest.mark.parametrize(("kind", "shading"), [("SURFACE", "SOLID"), ("POINTS", "MATERIAL"), ("SPLATS", "MATERIAL")])
def test_clicking_an_object_in_the_window_selects_it(window: Window, lift: Path, kind: str, shading: str) -> None:
    window.place(lift)
    window.run(_TOOLS + f"root.plgs.show_as, view.shading.type = {kind!r}, {shading!r}\n" + (
        "view.shading.color_type, view.shading.light = 'VERTEX', 'FLAT'\n" if shading == "SOLID" else ""
    ))  # fmt: skip
    rows = window.run("answer = [(row.instance_id, [round(255 * each) for each in row.colour]) "
                      "for row in root.plgs.instances]\n")  # fmt: skip
    numbers, colours = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    total = right = wrong = 0
    for name, statements in _VIEWS.items():
        window.run(f"{statements}\narea.tag_redraw()")
        window.move(SIZE[0] // 2, SIZE[1] - 5)
        window.settle(timeout=400)
        window.screenshot(f"clicks-{kind.lower()}-{name}")
        left, base, width, height = window.run("answer = region.x, region.y, region.width, region.height\n")
        seen = window.picture()[::-1][base : base + height, left : left + width].astype(int)
        pixels = np.stack(np.meshgrid(np.arange(4, width, STEP), np.arange(4, height, STEP)), axis=-1).reshape(-1, 2)
        drawn = seen[pixels[:, 1], pixels[:, 0]]
        apart = np.abs(drawn[:, None] - colours).max(axis=2)
        truth = np.where(apart.min(axis=1) <= 3, numbers[apart.argmin(axis=1)], 0)
        chosen = np.flatnonzero(truth)
        found = np.array(window.run(f"answer = picked({pixels[chosen].tolist()})\n", timeout=600))
        here = [len(chosen), int((found == truth[chosen]).sum()), int(((found != truth[chosen]) & (found > 0)).sum())]
        print(f"{kind} {name}: {here[0]} pixels, right {here[1] / here[0]:.3f}, wrong {here[2] / here[0]:.3f}")
        total, right, wrong = total + here[0], right + here[1], wrong + here[2]
    print(f"{kind}: {total} pixels, right {right / total:.4f}, wrong {wrong / total:.4f}")
    assert total > 1000 and right >= RIGHT * total and wrong <= WRONG * total
