"""A lift goes on whatever happens to Blender's file and window, and what happens to the lift is seen in Blender."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from blender import SIZE, Window
from tiny_scene import write_tiny_scene

from engine.job import LiftFolder

MODULES = """
import sys, pathlib
import numpy as np
lifts = sys.modules[EXTENSION + '.plgs_blender.running.lifts']
settings = lambda: bpy.context.scene.plgs
running = lambda: lifts.registry.running(lifts.Lift)
followed = lambda: lifts.lift_of(pathlib.Path(settings().lift_folder))
picture = lambda: sys.modules[EXTENSION + '.plgs_blender.running.lifts'].picture_for(bpy.context.scene)
"""
AT_ONCE = "warm_start=false"
"""Options of a lift that trains as soon as it can. Its first pictures show little."""
BLOCKS = 8
"""Of a picture, in each direction: their mean colours are compared."""
SOLID = 250
"""Least opacity, of 255, of what is compared."""
SEEN_BY_CAMERA = f"""
from bpy_extras.view3d_utils import location_3d_to_region_2d
area = next(each for each in bpy.context.window.screen.areas if each.type == 'VIEW_3D')
region = next(each for each in area.regions if each.type == 'WINDOW')
bpy.ops.wm.redraw_timer(type='DRAW_WIN_SWAP', iterations=1)
camera, view = bpy.context.scene.camera, area.spaces.active.region_3d
corners = [camera.matrix_world @ each for each in camera.data.view_frame(scene=bpy.context.scene)]
spots = [location_3d_to_region_2d(region, view, each) for each in corners]
if view.view_perspective != 'CAMERA':
    spots = [type(spots[0])(each) for each in ((0, 0), (region.width, region.height))]
np.save({{path!r}}, picture()[::-1])
answer = {{{{
    'columns': [region.x + pick(each.x for each in spots) for pick in (min, max)],
    'rows': [{SIZE[1]} - region.y - pick(each.y for each in spots) for pick in (max, min)],
}}}}
"""
"""Where the camera's frame, or the whole view, is on the screen; its picture is saved at ``path``."""


@pytest.fixture
def scene(work_folder: Path) -> Path:
    folder = work_folder / "tiny"
    return folder if folder.exists() else write_tiny_scene(folder)


def begin(window: Window, scene: Path, name: str, **settings: object) -> LiftFolder:
    """A lift of many steps, up to its first training steps, which come at once, with the sidebar open."""
    window.open_sidebar()
    window.run(MODULES)
    folder = scene.parent / name
    wanted = {"scene_folder": str(scene), "lift_folder": str(folder), "steps": 20_000, "preset_options": AT_ONCE}
    for key, value in {**wanted, **settings}.items():
        window.run(f"settings().{key} = {value!r}")
    window.wait_for("bpy.ops.plgs.lift_scene.poll()")
    window.run("bpy.ops.plgs.lift_scene('INVOKE_DEFAULT')")
    window.wait_for("followed() is not None and followed().progress.loss is not None")
    return LiftFolder.open(folder)


def off_by(window: Window, lift: LiftFolder) -> tuple[float, float]:
    """How far (mean) the colours within the camera's frame on the screen are from the live preview's, of 255, and how
    far from each other. Only its left half: the sidebar covers the right. Nor blocks at the edge, where a line is, nor
    what the cloud is seen through.
    """
    look = SEEN_BY_CAMERA.format(path=str(window.folder / "picture.npy"))
    with window.suspended(lift.path):  # there would be a new picture while the screen is looked at
        window.settle()  # the last picture may still be read
        seen, screen = window.run(look), window.picture()
    (left, right), (top, bottom) = ([round(each) for each in seen[side]] for side in ("columns", "rows"))
    picture = cv2.resize(np.load(window.folder / "picture.npy"), (right - left, bottom - top))
    compared = np.dstack([255.0 * picture, screen[top:bottom, left:right]])
    off, shown = [], []
    for rows in np.array_split(compared, BLOCKS)[1:-1]:
        for block in np.array_split(rows, BLOCKS, axis=1)[1 : BLOCKS // 2]:
            shown.append(block[..., 4:].mean((0, 1)))
            if len(solid := block[block[..., 3] > SOLID]) > block[..., 3].size // 2:
                off.append(np.abs((solid[:, :3] - solid[:, 4:]).mean(0)))
    assert off
    return float(np.mean(off)), float(np.ptp(shown, axis=0).max())


def end(window: Window) -> None:
    window.run("bpy.ops.plgs.cancel_lift()")
    window.wait_for("not running()")


@pytest.mark.slow
def test_a_running_lift_stays_in_the_panel_after_undo_or_opening_a_file(window: Window, scene: Path) -> None:
    lift = begin(window, scene, "through undo")
    window.run("bpy.ops.mesh.primitive_cube_add(); bpy.ops.ed.undo_push(message='cube')")
    window.move(500, 500)
    window.key("ctrl+z")
    window.settle()
    assert window.ask("followed().is_running")
    saved = scene.parent / "with lift.blend"
    window.run(f"bpy.ops.wm.save_as_mainfile(filepath={str(saved)!r})")
    window.run("bpy.ops.wm.read_homefile(use_splash=False)")
    assert lift.is_running and window.ask("len(running())") == 1
    window.run(f"bpy.ops.wm.open_mainfile(filepath={str(saved)!r})")
    window.wait_for("followed().is_running")
    step = window.ask("followed().progress.step")
    window.wait_for(f"followed().progress.step > {step}")
    end(window)
    assert window.ask("followed().can_be_resumed")


def test_the_window_stays_responsive_during_a_lift(window: Window, scene: Path) -> None:
    """Each call of Blender's into the extension, panels, timers and drawing included, with live previews before two
    cameras, one of a frame, then the user's own, and then of the view itself. Only the drawing over the view is not
    counted until the first picture is there: the processor, which stands in for a graphics card, compiles a shader for
    it (0.3 s).
    """
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(scene)!r}")
    window.run("bpy.ops.plgs.import_scene()")
    frame = window.ask("next(each.name for each in bpy.data.objects if 'frame' in each)")
    window.run(f"bpy.data.objects['Camera'].matrix_world = bpy.data.objects[{frame!r}].matrix_world")
    window.run("bpy.data.objects['Camera'].location.z += 0.2")
    window.run("watch.begin()")
    # With Gaussians in free space, too: else the pictures of so few steps have much fine grain.
    lift = begin(window, scene, "without waits", preset_options="free_space=false")
    window.move(500, 500)
    window.key("KP_0")
    window.wait_for("picture() is not None")
    window.run("bpy.ops.wm.redraw_timer(type='DRAW_WIN_SWAP', iterations=1)")
    slow = {call: waits for call, waits in window.slow_calls(0.05).items() if "_draw_on_top" not in call}
    window.run("watch.begin()")
    for camera, shot in ((frame, "of-a-frame"), ("Camera", "of-the-users"), ("Camera", "of-the-view")):
        window.run(f"bpy.context.scene.camera = bpy.data.objects[{camera!r}]")
        if shot == "of-the-view":
            window.key("KP_0")
        window.run("before = followed().progress.live_previews")
        window.wait_for("followed().progress.live_previews > before + 1 and picture() is not None")
        window.screenshot(f"live-preview-{shot}")
        error, contrast = off_by(window, lift)
        assert error < 8 < 30 < contrast, (camera, error, contrast)
    slow |= window.slow_calls(0.05)
    end(window)
    assert not slow


def test_closing_blender_ends_a_lift_unless_it_may_go_on(window: Window, scene: Path) -> None:
    ending = begin(window, scene, "ends with Blender")
    window.quit()
    window.new_file()
    assert not ending.is_running

    going_on = begin(window, scene, "goes on", keep_running=True)
    window.kill()
    assert going_on.is_running
    window.new_file()
    window.open_sidebar()
    window.run(MODULES)
    window.wait_for(f"any(str(each.folder.path) == {str(going_on.path)!r} for each in lifts.recent)")
    window.run(f"bpy.ops.plgs.watch_lift('INVOKE_DEFAULT', lift_folder={str(going_on.path)!r})")
    window.wait_for("followed().is_running and followed().progress.step > 0")
    end(window)
    assert not going_on.is_running
