"""Importing a scene's cameras, and what a dropped file opens."""

from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from plgs.engine.scene import open_scene
from plgs.plgs_blender import registry
from plgs.plgs_blender.cameras import SHOWN
from plgs.plgs_blender.engine_environment import usable_python
from plgs.plgs_blender.frame_pictures import MASKS
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.running.survey import SceneLook, Survey, look, obstacles_to, survey_of
from plgs.plgs_blender.settings import chosen_scene
from plgs.ui import overlay

from tests.raises_key import worded
from tests.scene.formats.test_colmap import write_text


def test_import_scene_adds_cameras_without_lifting(room: Path) -> None:
    assert bpy.ops.plgs.import_scene(scene_folder=str(room)) == {"FINISHED"}
    scene = bpy.context.scene
    cameras = [ob for ob in scene.objects if "frame" in ob]
    others = {ob.name.partition(".")[0] for ob in scene.objects if ob not in cameras}
    assert len(cameras) == 8 and others == {"Camera path", "Coloured cloud"}
    assert all(camera.data.background_images[0].image for camera in cameras)
    assert len(scene.timeline_markers) == 8 and scene.camera in cameras
    assert Path(bpy.path.abspath(scene.plgs.scene_folder)) == room


def test_placing_a_lift_uses_the_collection_of_its_imported_scene(lift: Path) -> None:
    scene_folder = lift.parent / "tiny room"
    bpy.ops.plgs.import_scene(scene_folder=str(scene_folder))
    imported = {ob for ob in bpy.context.scene.objects if ob.type == "CAMERA"}
    bpy.ops.plgs.place_lift(lift_folder=str(lift))
    assert imported <= set(bpy.context.scene.objects)
    assert len([c for c in bpy.data.collections if c.name.startswith("PLGS")]) == 1
    assert "Coloured cloud" not in bpy.context.scene.objects, "the lift's own points take its place"
    placed = {ob.name for ob in bpy.context.scene.objects}
    bpy.ops.plgs.import_scene()
    assert {ob.name for ob in bpy.context.scene.objects} == placed, "importing again keeps the result"


def looked_at(settings: object) -> Survey:
    """What an engine finds in the panel's scene."""
    look(chosen_scene(settings), usable_python())
    looking = registry.latest(SceneLook)
    registry.wait_for(looking, bpy.context.scene)
    survey = survey_of(chosen_scene(settings))
    assert survey is not None
    return survey


def test_the_panel_shows_what_the_chosen_folder_contains(room: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder = str(room)
    survey = survey_of(chosen_scene(settings))
    assert survey is not None and survey.error is None
    assert (survey.frames, survey.sizes) == (8, (((64, 48), 8),))
    bpy.ops.plgs.import_scene(scene_folder=str(room))
    scene = bpy.context.scene
    scene.camera = next(ob for ob in scene.objects if "frame" in ob)
    view = SimpleNamespace(region_3d=SimpleNamespace(view_perspective="CAMERA"), use_local_camera=False)
    through, (root,) = SimpleNamespace(scene=scene, space_data=view), lifts_in(scene)
    looked_at(settings)
    assert not overlay.legend_of(through, root)
    scene.camera[SHOWN] = MASKS
    assert dict(overlay.legend_of(through, root)) == dict(overlay.classes_of_scene(scene)), "masks have a legend"
    stuff = {name for name, _ in overlay.classes_of_scene(scene, stuff_only=True)}
    assert stuff and stuff == {each.name for each in open_scene(room).classes.categories if not each.is_thing} & {
        *dict(overlay.classes_of_scene(scene))
    }, "a live preview gives objects colours of their own"
    colours = {each.name: each.colour for each in open_scene(room).classes.categories}
    shown = dict(overlay.classes_of_scene(scene))
    assert (
        shown
        and shown.items()
        <= {name: tuple(channel / 255.0 for channel in colour) for name, colour in colours.items()}.items()
    )


def test_the_panel_says_whether_a_scene_can_be_lifted(room: Path, tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder = str(room)
    survey = survey_of(chosen_scene(settings))
    assert survey is not None and survey.format == "scannet" and survey.picture_files == 8
    assert not any(obstacles_to(survey, has_engine=True).values())
    settings.scene_folder = str(write_text(tmp_path / "walk"))
    survey = looked_at(settings)
    assert survey.format == "colmap" and survey.sparse_points == 6
    found = {what: why_not for what, why_not in obstacles_to(survey, has_engine=False).items() if why_not is not None}
    assert found == {"Lift": "no depth and no masks; choose depth maps and choose or make masks below"}
    with bpy.context.temp_override(plgs_panel=settings):
        assert bpy.ops.plgs.import_scene.poll() and not bpy.ops.plgs.lift_scene.poll()
    with pytest.raises(RuntimeError, match=worded("no-depth")):
        bpy.ops.plgs.lift_scene(lift_folder=str(tmp_path / "lift"))
    assert not (tmp_path / "lift").exists()


def test_a_bad_scene_folder_is_reported_and_disables_the_button(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder = str(tmp_path)
    survey = looked_at(settings)
    assert survey.error is not None and survey.error.fix
    with bpy.context.temp_override(plgs_panel=settings):
        assert not bpy.ops.plgs.import_scene.poll() and not bpy.ops.plgs.lift_scene.poll()
    with pytest.raises(RuntimeError, match=str(tmp_path)):
        bpy.ops.plgs.import_scene()
    assert len(bpy.data.objects) == 0


def test_a_dropped_file_opens_its_scene_or_its_lift(room: Path, lift: Path) -> None:
    settings = bpy.context.scene.plgs
    bpy.ops.plgs.open_dropped(filepath=str(next((room / "pose").iterdir())))
    assert Path(settings.scene_folder) == room
    bpy.ops.plgs.open_dropped(filepath=str(lift / "result" / "instances.json"))
    assert Path(settings.lift_folder) == lift


def test_a_dropped_scene_does_not_use_masks_of_the_scene_before(room: Path, tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder, settings.masks, settings.depth, settings.up = str(tmp_path), "masks", "depth", "y"
    bpy.ops.plgs.open_dropped(filepath=str(room))
    assert (Path(settings.scene_folder), settings.masks, settings.depth, settings.up) == (room, "", "", "z")
    settings.masks = "own"
    bpy.ops.plgs.open_dropped(filepath=str(room))
    assert settings.masks == "own", "the same scene keeps what was chosen for it"


@pytest.mark.parametrize(
    ("file", "scene"),
    [
        ("walk/sparse/0/images.txt", "walk"),
        ("walk/images/img_5.png", "walk"),
        ("studio/transforms.json", "studio"),
        ("scans/one.sens", "scans/one.sens"),
    ],
)
def test_a_dropped_file_opens_any_capture(captures: Path, file: str, scene: str) -> None:
    bpy.ops.plgs.open_dropped(filepath=str(captures / file))
    assert Path(bpy.context.scene.plgs.scene_folder) == captures / scene
