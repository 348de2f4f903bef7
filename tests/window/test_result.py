"""What is seen when a finished lift is shown, in a file as Blender starts it."""

from __future__ import annotations

from pathlib import Path

import pytest
from blender import SIZE, Window
from tiny_lift import write_tiny_lift

# Where the corners of the lift's boxes lie in the view, in shares of what the sidebar leaves free.
PLACES = """
from bpy_extras.view3d_utils import location_3d_to_region_2d
area = next(each for each in bpy.context.window.screen.areas if each.type == 'VIEW_3D')
window = next(each for each in area.regions if each.type == 'WINDOW')
bar = next(each for each in area.regions if each.type == 'UI')
answer = []
for each in bpy.context.scene.objects:
    if each.get('plgs_key', '').startswith('instance:'):
        for corner in each.data.vertices:
            at = location_3d_to_region_2d(window, area.spaces.active.region_3d, each.matrix_world @ corner.co)
            answer.append((at.x / (window.width - bar.width), at.y / window.height))
"""

VIEW = """
area = next(each for each in bpy.context.window.screen.areas if each.type == 'VIEW_3D')
with bpy.context.temp_override(area=area, region=next(each for each in area.regions if each.type == 'WINDOW')):"""
# Where the corners of the camera's frame lie, in the same shares.
FRAME = """
from bpy_extras.view3d_utils import location_3d_to_region_2d
area = next(each for each in bpy.context.window.screen.areas if each.type == 'VIEW_3D')
window = next(each for each in area.regions if each.type == 'WINDOW')
bar = next(each for each in area.regions if each.type == 'UI')
view, camera = area.spaces.active.region_3d, bpy.context.scene.camera
corners = [camera.matrix_world @ each for each in camera.data.view_frame(scene=bpy.context.scene)]
spots = [location_3d_to_region_2d(window, view, each) for each in corners]
answer = [(at.x / (window.width - bar.width), at.y / window.height) for at in spots]
"""


@pytest.fixture(scope="module")
def lift(work_folder: Path) -> Path:
    return write_tiny_lift(work_folder / "shown", frames=4, bake=False).path


def test_a_placed_lift_fits_the_view_beside_the_panels(window: Window, lift: Path) -> None:
    window.open_sidebar()
    window.run("bpy.context.scene.eevee.taa_samples = 1")  # of 16, each of which takes seconds
    window.run(f"bpy.ops.plgs.place_lift(lift_folder={str(lift)!r})")
    window.settle()
    window.screenshot("result")
    places = window.run(PLACES)
    assert places and all(0.0 < x < 1.0 and 0.0 < y < 1.0 for x, y in places)
    shading = "next(a for a in bpy.context.window.screen.areas if a.type == 'VIEW_3D').spaces.active.shading"
    shown = f"({shading}.type, {shading}.light, {shading}.color_type)"
    assert window.ask(shown) == ["MATERIAL", "STUDIO", "MATERIAL"], "other objects look as they do in Material Preview"
    window.run(f"{shading}.type = 'SOLID'\nbpy.ops.plgs.place_lift(lift_folder={str(lift)!r})")
    assert window.ask(shown) == ["SOLID", "STUDIO", "MATERIAL"], "who turned to Solid shading stays there"


def test_the_buttons_for_a_selected_object_are_in_view(window: Window, lift: Path) -> None:
    """In a window 1000 pixels high, with the first steps folded; and few names and no boxes are drawn over the room."""
    window.open_sidebar()
    window.place(lift)
    window.settle()
    window.screenshot("result-panel")
    _, y = window.find_button("plgs.matte_instance")
    assert y < SIZE[1] - 120
    with pytest.raises(LookupError):
        window.find_button("plgs.lift_scene")
    overlays = "next(a for a in bpy.context.window.screen.areas if a.type == 'VIEW_3D').spaces.active.overlay"
    window.move(SIZE[0] // 3, SIZE[1] // 2)
    window.key("shift+alt+z")
    window.settle()
    assert not window.ask(f"{overlays}.show_overlays")
    window.key("shift+alt+z")
    window.settle()
    assert window.ask(f"{overlays}.show_overlays")


def test_without_a_graphics_card_a_lift_opens_in_solid_shading(window: Window, lift: Path) -> None:
    """As this screen is drawn."""
    viewport = "__import__('sys').modules[EXTENSION + '.plgs_blender.viewport']"
    window.run(f"__import__('importlib').reload({viewport})")
    assert window.ask(f"{viewport}.draws_in_software()")
    window.open_sidebar()
    window.place(lift)
    window.settle()
    window.screenshot("result-in-software")
    shading = "next(a for a in bpy.context.window.screen.areas if a.type == 'VIEW_3D').spaces.active.shading"
    assert window.ask(f"({shading}.type, {shading}.color_type)") == ["SOLID", "VERTEX"]


def test_a_frames_picture_fits_the_view_beside_the_panels(window: Window, lift: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.ops.plgs.place_lift(lift_folder={str(lift)!r})")
    window.run(f"{VIEW}\n    bpy.ops.plgs.go_to_frame(frame='0001')")
    window.settle()
    window.screenshot("frame")
    across, up = zip(*window.run(FRAME), strict=True)
    assert min(*across, *up) > 0.0 and max(*across, *up) < 1.0
    assert max(max(across) - min(across), max(up) - min(up)) > 0.8
    zoom = "area.spaces.active.region_3d.view_camera_zoom"
    window.run(f"{VIEW}\n    {zoom} = 60.0\n    bpy.ops.plgs.go_to_frame(frame='0002')")
    assert window.run(f"{VIEW}\n    answer = {zoom}") == 60.0, "who zooms stays there"
