"""A lift that is shown in Blender's window, with one panel open in a tab of its own: nothing in Python opens a closed
panel."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from blender import SIZE, Window
from tree import ROOT

OTHER = os.environ.get("PLGS_PICTURES_LIFT", "")
"""A finished lift below build, with its surface exported, in place of the sample's."""
CHAIR, CABINET = 1, 2
_OWN_TAB = """
panel = bpy.types.{panel}
bpy.utils.unregister_class(panel)
kept = {{name: getattr(panel, name) for name in ('bl_options', 'bl_parent_id', 'bl_category') if hasattr(panel, name)}}
panel.bl_options, panel.bl_category = set(), '{tab}'
if 'bl_parent_id' in kept:
    panel.bl_parent_id = ''
bpy.utils.register_class(panel)
"""
_BACK = """
bpy.utils.unregister_class(panel)
for name, value in kept.items():
    setattr(panel, name, value)
bpy.utils.register_class(panel)
"""
_TOOLS = """
import sys
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
inspecting = sys.modules[EXTENSION + '.plgs_blender.inspecting.selection']

def lift():
    return inspecting.active_lift(bpy.context.window_manager.windows[0].scene, None)

def points(number):
    clouds = [each for each in inspecting.clouds_of(lift()) if 'class_id' in each]
    return sum(int((inspecting.ids_of(each.data, 'instance_id') == number).sum()) for each in clouds)

def boxes():
    return inspecting.boxes_of(lift())

def ids():
    return sorted(row.instance_id for row in lift().plgs.instances)

def place(number):
    return place_of(inspecting.boxes_of(lift())[number].matrix_world.translation)

def place_of(point):
    window = bpy.context.window_manager.windows[0]
    area = max((each for each in window.screen.areas if each.type == 'VIEW_3D'), key=lambda each: each.width)
    region = next(each for each in area.regions if each.type == 'WINDOW')
    at = location_3d_to_region_2d(region, area.spaces.active.region_3d, point)
    return round(region.x + at.x), round(region.y + at.y)

def seen(number):
    # A pixel of the window where an object is seen near its middle, or the floor (0), and no name.
    names = ('picking', 'rays')
    picking, rays = (sys.modules[EXTENSION + '.plgs_blender.inspecting.' + each] for each in names)
    window = bpy.context.window_manager.windows[0]
    area = max((each for each in window.screen.areas if each.type == 'VIEW_3D'), key=lambda each: each.width)
    region = next(each for each in area.regions if each.type == 'WINDOW')
    x, y = place(number) if number else (region.x + region.width // 3, region.y + region.height // 3)
    with bpy.context.temp_override(window=window, area=area, region=region):
        for step in range(0, 200, 4):
            for aside, up in ((step, 0), (-step, 0), (0, step), (0, -step)):
                at = x + aside - region.x + 0.5, y + up - region.y + 0.5
                found = picking.what_is_under(bpy.context, at)
                if found is not None and found.instance == number:
                    return x + aside, y + up

def sidebar():
    areas = bpy.context.window_manager.windows[0].screen.areas
    area = max((each for each in areas if each.type == 'VIEW_3D'), key=lambda each: each.width)
    return next(each for each in area.regions if each.type == 'UI')

def choose(*numbers):
    for key, box in inspecting.boxes_of(lift()).items():
        box.hide_set(key not in numbers)
        box.select_set(key in numbers)
    bpy.context.view_layer.objects.active = inspecting.boxes_of(lift())[numbers[0]]
    lift().plgs.instance_index = next(i for i, row in enumerate(lift().plgs.instances) if row.instance_id == numbers[0])
"""


@contextmanager
def shown_lift(window: Window, folder: Path, panel: str, tab: str, *, bake: bool = False) -> Iterator[Path]:
    """A lift of its own in ``folder``, shown, with this panel open."""
    import tiny_lift

    lift = tiny_lift.write_tiny_lift(folder / "lift", bake=bake).path
    window.run(_OWN_TAB.format(panel=panel, tab=tab))
    try:
        window.place(lift)
        window.run(_TOOLS)
        window.run("bpy.ops.ed.undo_push(message='shown')")
        window.open_sidebar(tab)
        window.settle()
        yield lift
    finally:
        if window.is_running:
            window.run(_BACK)


def over(window: Window, number: int) -> tuple[int, int]:
    """Where an object's middle is on the screen."""
    x, y = window.ask(f"place({number})")
    return x, SIZE[1] - y


def upon(window: Window, number: int) -> tuple[int, int]:
    """Where an object, or the floor (0), is seen on the screen: points leave gaps."""
    x, y = window.ask(f"seen({number})")
    return x, SIZE[1] - y


def large_lift(folder: Path) -> Path:
    """The sample's lift as `make demo` makes it, in a folder, with the surface that a window makes after a lift; or the
    other."""
    if OTHER:
        return (ROOT / OTHER).resolve()
    lift, python = folder / "room lift", ROOT / ".venv" / "bin" / "python"
    surface = lift / "exports" / "surface"
    subprocess.run([python, "-m", "engine", "lift", "sample/room", "-o", lift], cwd=ROOT, check=True)
    subprocess.run([python, "-m", "engine", "export", lift, "--to", "surface", "-o", surface], cwd=ROOT, check=True)
    return lift
