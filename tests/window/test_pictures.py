"""The pictures of docs/blender.md, of the sample in Blender's window; and its splats look like its photos.

    PLGS_WINDOW_TREE=build/blender-trixie .venv/bin/python -m pytest tests/window/test_pictures.py

With PLGS_PICTURES_LIFT, a finished lift of another scene with its surface exported, the same pictures are taken of that
lift and named after its folder: look at them. The lift and its scene have to be in this clone, below build.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from blender import SIZE, Window
from numpy.typing import NDArray
from shown_lift import OTHER, large_lift
from tree import ROOT

from engine.job import LiftFolder
from engine.scene_of_lift import scene_of_lift

pytestmark = pytest.mark.slow
of_the_sample = pytest.mark.skipif(bool(OTHER), reason="the lift is done")
FRAME = "0014"
LIKE_DB = 20.0
"""Least PSNR of the splats in Material Preview to a photo, after one gain and offset for each channel."""
PATIENCE_S = 400
"""For a lift of a real capture, drawn without a GPU beside other work."""
_IN_VIEW = """
import sys
lookup = sys.modules[EXTENSION + '.plgs_blender.inspecting.selection']
window = bpy.context.window_manager.windows[0]
area = next(each for each in window.screen.areas if each.type == 'VIEW_3D')
region = next(each for each in area.regions if each.type == 'WINDOW')
view = area.spaces.active
root = lookup.active_lift(window.scene, None)
window.scene.plgs['scene_folder'] = '/home/artist/room'
with bpy.context.temp_override(window=window, area=area, region=region):
"""
_CORNERS = """
from bpy_extras.view3d_utils import location_3d_to_region_2d
camera = window.scene.camera
frame = [camera.matrix_world @ each for each in camera.data.view_frame(scene=window.scene)]
spots = [location_3d_to_region_2d(region, view.region_3d, each) for each in frame]
answer = [[region.x + each.x, region.y + each.y] for each in spots]
"""
_BEFORE_NOTHING = """
view.region_3d.view_perspective = 'CAMERA'
view.overlay.show_overlays = view.show_gizmo = view.show_region_ui = view.show_region_toolbar = False
view.show_region_header = view.show_region_tool_header = False
window.scene.camera.data.show_background_images = False
"""
_LOOK_THROUGH = """
window = bpy.context.window_manager.windows[0]
window.scene.camera = bpy.data.objects['0012']
view = next(each for each in window.screen.areas if each.type == 'VIEW_3D').spaces.active
import sys
sys.modules[EXTENSION + '.plgs_blender.viewport'].look_through(view, window.scene)
"""
_CALLED = """
import dataclasses, sys
survey = sys.modules[EXTENSION + '.plgs_blender.running.survey']
settings = bpy.context.window_manager.windows[0].scene.plgs
settings['scene_folder'] = '/home/artist/room'
chosen = sys.modules[EXTENSION + '.plgs_blender.settings'].chosen_scene(settings)
survey._latest = dataclasses.replace(survey._latest, chosen=chosen)
for area in bpy.context.window_manager.windows[0].screen.areas:
    area.tag_redraw()
"""
"""Lets the panel call the scene that it has read by another name than that of this machine's folder."""
_IS_READ = "not __import__('sys').modules[EXTENSION + '.plgs_blender.running.survey']._latest.is_looking"
_SHOWN = "max(root.plgs.instances, key=lambda each: (each.class_name == 'sofa', each.points))"
_LIFTS = "__import__('sys').modules[EXTENSION + '.plgs_blender.running.lifts']"
_RUNNING = f"{_LIFTS}.registry.running({_LIFTS}.Lift)"


@pytest.fixture(scope="module")
def lift(work_folder: Path) -> Path:
    """The sample's lift as `make demo` makes it, with the surface that a window makes after a lift; or the other."""
    return large_lift(work_folder)


@pytest.fixture(scope="module")
def scene(work_folder: Path) -> Path:
    """A copy of the sample, beside which an import writes."""
    return shutil.copytree(ROOT / "sample" / "room", work_folder / "room")


@pytest.fixture
def shown(window: Window, lift: Path) -> Window:
    window.open_sidebar()
    window.run(f"bpy.ops.plgs.place_lift(lift_folder={str(lift)!r})", timeout=PATIENCE_S)
    in_view(window, "pass")
    return window


def taken_of(lift: Path, name: str) -> str:
    """The name of a screenshot."""
    return f"{lift.name if OTHER else 'docs'}-{name}"


def in_view(window: Window, statements: str) -> None:
    """Run statements where the 3D view is the context, and wait until it is drawn."""
    window.run(_IN_VIEW + "\n".join(f"    {line}" for line in statements.splitlines()), timeout=PATIENCE_S)
    window.move(SIZE[0] // 2, SIZE[1] - 5)
    window.settle(timeout=PATIENCE_S)


def test_the_first_view_of_a_lift_shows_its_colours(shown: Window, lift: Path) -> None:
    assert shown.run(_IN_VIEW + "    answer = [root.plgs.show_as, view.shading.type]\n") == ["SURFACE", "MATERIAL"]
    shown.screenshot(taken_of(lift, "opened"))
    seen = []
    for look in ("PHOTO", "CLASSES", "INSTANCES", "UNCERTAINTY"):
        in_view(shown, f"root.plgs.look = {look!r}")
        seen.append(cv2.imread(str(shown.screenshot(taken_of(lift, f"look-{look.lower()}")))))
    assert all((one != other).any(axis=2).mean() > 0.05 for one, other in zip(seen, seen[1:], strict=False))


def test_every_shading_mode_shows_the_lift(shown: Window, lift: Path) -> None:
    for kind in ("POINTS", "SPLATS", "SURFACE"):
        in_view(shown, f"bpy.ops.plgs.show_as(kind={kind!r})")
        assert shown.run(_IN_VIEW + "    answer = view.shading.type\n") == "MATERIAL"
        for shading in ("RENDERED", "SOLID", "MATERIAL"):
            in_view(shown, f"view.shading.type = {shading!r}")
            shown.screenshot(taken_of(lift, f"{kind.lower()}-{shading.lower()}"))


def test_splats_look_like_the_photo(shown: Window, lift: Path) -> None:
    frames = scene_of_lift(LiftFolder.open(lift)).frames
    seen = next((each for each in frames if each.name == FRAME and not OTHER), frames[len(frames) // 3])
    in_view(shown, f"bpy.ops.plgs.show_as(kind='SPLATS')\nbpy.ops.plgs.go_to_frame(frame={seen.name!r})")
    in_view(shown, _BEFORE_NOTHING + "bpy.ops.view3d.view_center_camera()")
    corners = np.array(shown.run(_IN_VIEW + "    pass" + _CORNERS))
    (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
    rows = slice(round(SIZE[1] - top), round(SIZE[1] - bottom))
    splats = shown.picture()[rows, round(left) : round(right)]
    photo = seen.read_colour(splats.shape[1::-1])
    pair = np.concatenate([photo, splats], axis=1)[..., ::-1]
    cv2.imwrite(str(ROOT / "build" / "window" / "screenshots" / f"{taken_of(lift, 'beside')}.png"), pair)
    alike = fitted_psnr(splats, photo)
    print(f"splats and photo: {alike:.1f} dB")
    assert OTHER or alike > LIKE_DB


def fitted_psnr(seen: NDArray[np.uint8], photo: NDArray[np.uint8]) -> float:
    """PSNR in dB of one picture to another of its size, after one gain and offset for each channel."""
    errors = []
    for channel in range(3):
        have, want = seen[..., channel].ravel() / 255.0, photo[..., channel].ravel() / 255.0
        errors.append(np.mean((np.polyval(np.polyfit(have, want, 1), have) - want) ** 2))
    return float(-10.0 * np.log10(np.mean(errors)))


def test_the_best_view_of_an_object_is_shown(shown: Window, lift: Path) -> None:
    in_view(shown, f"bpy.ops.plgs.select_instance(instance={_SHOWN}.instance_id)")
    in_view(shown, "bpy.ops.plgs.go_to_best_view()")
    shown.screenshot(taken_of(lift, "best-view"))


@of_the_sample
def test_a_running_lift_is_shown_in_the_window(window: Window, scene: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.ops.plgs.import_scene(scene_folder={str(scene)!r})", timeout=PATIENCE_S)
    window.run(_LOOK_THROUGH)
    window.run("bpy.ops.plgs.lift_scene('INVOKE_DEFAULT')")
    step, seen = f"{_RUNNING}[0].progress.step", f"{_LIFTS}.picture_for(bpy.context.scene) is not None"
    window.wait_for(f"{_RUNNING} and {step} > 250 and {seen}", timeout=300)
    window.run(_CALLED)
    window.wait_for(f"{step} > 260")
    window.screenshot("docs-lifting")
    window.run(f"bpy.ops.plgs.cancel_lift(lift_folder=str({_RUNNING}[0].folder.path))")
    window.wait_for(f"not {_RUNNING}", 20)


def test_the_compositor_shows_the_passes(shown: Window, lift: Path) -> None:
    in_view(shown, "bpy.ops.plgs.show_passes()")
    shown.screenshot(taken_of(lift, "compositor"))


@of_the_sample
def test_an_imported_scene_is_shown_in_the_window(window: Window, scene: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.ops.plgs.import_scene(scene_folder={str(scene)!r})", timeout=PATIENCE_S)
    window.wait_for(_IS_READ, PATIENCE_S)
    window.run(_CALLED)
    window.settle()
    window.screenshot("docs-imported")
    window.press("plgs.show_picture", "MASKS")
    window.wait_for("bpy.context.scene.camera.data.background_images[0].image is not None")
    window.move(SIZE[0] // 2, SIZE[1] - 5)
    window.settle(timeout=PATIENCE_S)
    window.screenshot("docs-masks")
