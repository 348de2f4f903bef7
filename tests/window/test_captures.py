"""In a window: the installed extension, captures that are dropped, imported, and diagnosed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from blender import SIZE, Window
from tiny_scene import write_tiny_scene

from engine.job import LiftFolder, LiftRequest
from tests.scene.formats.test_scannet import sens

FOOTPRINT = (Path(__file__).parent.parent / "footprint.py").read_text()


def test_the_zip_is_installed_and_enabled_in_the_window(window: Window) -> None:
    where = window.ask("__import__('sys').modules[EXTENSION].__file__")
    assert where == str(window.folder / "resources/extensions/user_default/plgs/__init__.py")
    assert window.ask("EXTENSION in bpy.context.preferences.addons and hasattr(bpy.context.scene, 'plgs')")


def test_disabling_and_reloading_the_extension_leaves_nothing_behind(window: Window) -> None:
    """By name, for add-ons of Blender's own do leave something; tests/test_register.py looks at everything."""
    window.open_sidebar()
    window.run(FOOTPRINT)
    window.run("def ours(): return [each for each in _lines(footprint()) if 'plgs' in each.lower()]")
    switched_on = window.ask("ours()")
    assert any("Scene.plgs" in each for each in switched_on) and any("PLGS_PT_" in each for each in switched_on)
    for _ in range(3):
        window.run("bpy.ops.script.reload()")
        window.settle()
        assert window.ask("ours()") == switched_on
        window.run("bpy.ops.preferences.addon_disable(module=EXTENSION)")
        window.settle()
        assert window.ask("ours()") == []
        assert window.ask("running_timers(EXTENSION)") == []
        window.run("bpy.ops.preferences.addon_enable(module=EXTENSION)")
        window.settle()
        assert window.ask("ours()") == switched_on


IN_THE_VIEW = SIZE[0] // 2 - 100, SIZE[1] // 2


@pytest.fixture(scope="module")
def scene(work_folder: Path) -> Path:
    """Under a name that has to be encoded on its way from the file manager."""
    return write_tiny_scene(work_folder / "dropped" / "my 100% räum", frames=2)


def folders(window: Window) -> list[str]:
    """The panel's scene folder and its lift folder."""
    chosen: list[str] = window.ask("bpy.context.scene.plgs.scene_folder, bpy.context.scene.plgs.lift_folder")
    return chosen


@pytest.mark.parametrize(
    "names", [["panoptic.json"], pytest.param(["pose/0000.txt", "pose/0001.txt"], marks=pytest.mark.slow)]
)
def test_a_scene_file_dropped_on_the_window_opens_it(window: Window, scene: Path, names: list[str]) -> None:
    window.drop(*IN_THE_VIEW, *(scene / name for name in names))
    assert folders(window) == [str(scene), ""]


def test_a_lift_file_dropped_on_the_window_opens_it(window: Window, scene: Path) -> None:
    lift = LiftFolder.create(scene.parent / "my lift", LiftRequest(scene=scene))
    window.drop(*IN_THE_VIEW, lift.path / "request.json")
    assert folders(window) == ["", str(lift.path)]


PREPARED = """
import sys
registry = sys.modules[EXTENSION + '.plgs_blender.registry']
film = lambda: registry.latest(sys.modules[EXTENSION + '.plgs_blender.running.preparation'].FilmMaking)
"""


def test_a_dropped_film_is_prepared_or_says_what_must_be_downloaded(window: Window, work_folder: Path) -> None:
    path = work_folder / "my film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for shade in range(0, 200, 10):
        writer.write(np.full((48, 64, 3), shade, np.uint8))
    writer.release()
    window.run(PREPARED)
    window.drop(*IN_THE_VIEW, path)
    window.key("p")  # of the entries, as Blender itself shows films as pictures
    window.wait_for("film() is not None and not film().is_running")
    assert folders(window)[0] == str(path)
    window.settle()
    told = window.ask("str(film().error)")
    assert "this must be downloaded first" in told and "MB" in told and "Apache-2.0" in told
    window.open_sidebar()
    window.screenshot("dropped_film")


MODULES = """
import sys
registry = sys.modules[EXTENSION + '.plgs_blender.registry']
making = lambda: registry.latest(sys.modules[EXTENSION + '.plgs_blender.running.importing'].FrameMaking)
"""
PICTURES = "sum(len(each.data.background_images) for each in bpy.context.scene.objects if 'frame' in each)"
SHOWN = "bpy.context.scene.camera.data.background_images[0].image.name"


@pytest.fixture(scope="module")
def archive(work_folder: Path) -> Path:
    (work_folder / "scans").mkdir()
    path = work_folder / "scans" / "office.sens"
    path.write_bytes(sens())
    return path


def test_the_engine_adds_pictures_and_a_cloud_while_the_window_keeps_working(window: Window, archive: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(archive)!r}")
    window.press("plgs.import_scene")
    window.wait_for("'Camera path' in bpy.context.scene.objects")
    window.wait_for(f"{PICTURES} == 6")
    window.run(MODULES)
    window.wait_for("'Coloured cloud' in bpy.context.scene.objects and not making().is_running")
    assert window.ask("making().error") is None
    window.settle()
    window.screenshot("capture")


@pytest.mark.slow
def test_showing_a_depth_picture_can_be_undone(window: Window, archive: Path) -> None:
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(archive)!r}")
    window.press("plgs.import_scene")
    window.wait_for(f"{PICTURES} == 6")
    window.run("bpy.context.scene.camera = next(each for each in bpy.context.scene.objects if 'frame' in each)")
    window.run("bpy.ops.ed.undo_push(message='chosen')")
    window.settle()
    window.press("plgs.show_picture", contains="DEPTH")
    window.wait_for(f"{SHOWN}.startswith('Depth')")
    window.settle()
    window.screenshot("depth")
    window.run("bpy.ops.ed.undo()")
    assert window.ask(f"{SHOWN}.startswith('Depth')") is False
    window.run("bpy.ops.ed.undo(); bpy.ops.ed.undo()")
    assert window.is_running


EDITORS = "[a.spaces.active.image.name for a in bpy.context.screen.areas if a.type == 'IMAGE_EDITOR']"
MEASURED = """
import sys
diagnosis = sys.modules[EXTENSION + '.plgs_blender.running.diagnosis']
known = lambda: diagnosis.registry.latest(diagnosis.Diagnosis)
"""


@pytest.fixture(scope="module")
def odd(work_folder: Path) -> tuple[Path, str]:
    """A scene with one mask upside down, and that frame's name."""
    scene = write_tiny_scene(work_folder / "odd room", frames=14, size=(96, 72))
    mask = sorted((scene / "panoptic").iterdir())[6]
    cv2.imwrite(str(mask), cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)[::-1, ::-1])
    return scene, mask.stem


def test_a_diagnosis_finding_shows_a_picture_and_buttons(window: Window, odd: tuple[Path, str]) -> None:
    scene, frame = odd
    window.open_sidebar()
    window.run(f"bpy.context.scene.plgs.scene_folder = {str(scene)!r}")
    window.press("plgs.import_scene")
    window.wait_for("'Camera path' in bpy.context.scene.objects")
    window.run(MEASURED + "bpy.ops.plgs.diagnose('INVOKE_DEFAULT')")
    window.wait_for("known() is not None and not known().is_running and known().is_taken")
    assert window.ask("known().error") is None
    number = window.ask("next(n for n, each in enumerate(known().findings) if each.frames)")
    window.run(f"bpy.ops.plgs.show_finding(number={number})")
    window.settle()
    assert window.ask(EDITORS) != [], "it opens beside the view, which had no image editor"
    window.run(f"bpy.ops.plgs.go_to_finding(number={number}, frame={frame!r})")
    assert window.ask("bpy.context.scene.camera['frame']") == frame
    window.screenshot("findings")
    window.run(f"bpy.ops.plgs.leave_out(number={number})")
    assert frame not in (scene / "splits.json").read_text()
