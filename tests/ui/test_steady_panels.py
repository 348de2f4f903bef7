"""What is pressed stays where it is when an engine has news: nothing moves under the pointer."""

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import bpy
import pytest
import tiny_lift
from plgs.engine.errors import PlgsError
from plgs.engine.job.task import BAKE, LIFT, TaskState
from plgs.plgs_blender import proposals, registry
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.correction_tools import SplitByViews
from plgs.plgs_blender.engine_environment import choices, tasks
from plgs.plgs_blender.lift_scene import place_lift
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.running import lifts, survey
from plgs.plgs_blender.running.exports import FORMS, Export
from plgs.plgs_blender.settings import chosen_scene
from plgs.ui import lift_panel, scene_panel
from pretended_python import pretended_python
from tiny_scene import write_tiny_scene

from tests.raises_key import worded
from tests.ui.drawn_panels import Pretended, drawn, height_of, tasks_with

pytestmark = pytest.mark.usefixtures("extension")


def test_reading_a_scene_does_not_move_the_import_button(tmp_path: Path) -> None:
    """It is read a moment after the folder was chosen, when the mouse may be on the button."""

    def above() -> str:
        return drawn().partition("plgs.import_scene")[0]

    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    not_read = above()
    survey.look(chosen_scene(bpy.context.scene.plgs), Path(sys.executable))
    assert above() == not_read and "plgs.look_at_scene" in not_read
    registry.wait_for(registry.latest(survey.SceneLook), bpy.context.scene)  # type: ignore[arg-type]
    assert above() == not_read


def rows_above(what: str) -> int:
    """How much is drawn above a button or a list, with what can be folded up closed."""
    above, found, _ = drawn(opened=False).partition(what)
    assert found, what
    return above.count("\n")


def test_reading_a_scene_moves_no_button_below_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows that stand there from the start are filled; what varies in length is behind a row that tells of warnings."""
    bpy.context.scene.plgs.scene_folder = str(write_tiny_scene(tmp_path / "tiny"))
    chosen = chosen_scene(bpy.context.scene.plgs)
    monkeypatch.setattr(survey, "_latest", None)
    assert "Not read yet" in drawn()
    survey.look(chosen, Path(sys.executable))
    before = rows_above("plgs.lift_scene")
    assert "Reading the scene" in drawn() and "–" not in drawn()
    registry.wait_for(registry.latest(survey.SceneLook), bpy.context.scene)  # type: ignore[arg-type]
    found = survey.survey_of(chosen)
    assert found is not None and found.error is None
    shown = drawn()
    assert "6 frames\n" in shown and "4 classes" in shown
    assert "1 frame held out" in shown and "Possible: cameras, pictures" in shown
    assert rows_above("plgs.lift_scene") == before
    worse = replace(found, warnings=("one", "two"), inferred=(("Up: z: a guess", True),), has_depth=False)
    monkeypatch.setattr(survey, "_latest", replace(worse, depth_range=None, has_masks=False, left_out=2))
    shown = drawn(opened=False, width=280)
    assert "3 warnings: Up: z: a guess" in shown and "No masks: make them below" in shown and "two" not in shown
    assert rows_above("plgs.lift_scene") == before and "\nTwo\n" in drawn()


def test_progress_of_extracting_frames_replaces_the_import_button(tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    before, at = height_of(scene_panel.PLGS_PT_scene), rows_above("plgs.import_scene")
    registry.follow(tasks_with(Pretended(TaskState.RUNNING), tmp_path)[1])
    assert rows_above("Images 50 %") == at == rows_above("plgs.cancel_frames") - 1
    assert height_of(scene_panel.PLGS_PT_scene) == before


@pytest.mark.parametrize("of", [{"frame": "0001"}, {"chosen": ChosenScene(Path("another"))}])
def test_making_a_picture_does_not_move_the_import_button(of: dict[str, Any], tmp_path: Path) -> None:
    """Its bar is in *Frames*, where its button was pressed, and so are its warnings."""
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    at, pictures = rows_above("plgs.import_scene"), rows_above("plgs.show_picture Masks")
    making: Any = registry.follow(tasks_with(Pretended(TaskState.RUNNING), tmp_path)[1])
    making.order = replace(making.order, **of)
    shown = drawn()
    assert rows_above("plgs.import_scene") == at and rows_above("plgs.show_picture Masks") == pictures
    assert shown.index("plgs.show_picture Masks") < shown.index("Images 50 %") < shown.index("plgs.cancel_frames")
    assert "odd" in shown


def test_messages_of_the_engine_do_not_move_the_lift_button(tmp_path: Path) -> None:
    """Whether there is an engine, what a lift costs, that passes are baked: all comes while the mouse may be there."""
    lift = tiny_lift.write_tiny_lift(tmp_path / "lift").path
    settings = bpy.context.scene.plgs
    before = rows_above("plgs.lift_scene")
    settings.device = "cuda"
    choices.choose(pretended_python(tmp_path / "python", lacks="cuda"))
    try:
        registry.wait_for(tasks.check(), bpy.context.scene)  # type: ignore[arg-type]
        assert "Device CUDA: the engine lacks a-package" in drawn()
        assert rows_above("plgs.lift_scene") == before
    finally:
        choices.choose(None)
    settings.device = "cpu"
    settings.lift_folder = str(lift)
    followed = lifts.lift_of(lift)
    passes = rows_above("plgs.bake_passes")
    follower: Any = Pretended(TaskState.RUNNING)
    followed.follower, follower.kind = follower, BAKE
    assert rows_above("plgs.lift_scene") == before and rows_above("plgs.bake_passes") == passes
    follower.kind = LIFT
    bar = rows_above("1 min 30 s left")
    assert bar < rows_above("plgs.cancel_lift"), "a second click on Start is on the bar"


def test_a_starting_or_ending_lift_moves_no_button_below_it(tmp_path: Path) -> None:
    panel, settings = lift_panel.PLGS_PT_lift, bpy.context.scene.plgs
    assert "Not lifted yet" in drawn()
    before = height_of(panel)
    settings.lift_folder = str(tiny_lift.write_tiny_lift(tmp_path / "lift").path)
    followed = lifts.lift_of(Path(settings.lift_folder))
    assert followed is not None and height_of(panel) == before
    follower: Any = Pretended(TaskState.RUNNING)
    follower.progress.warnings = []
    follower.progress.label = "Training Gaussians"
    followed.follower = follower
    assert "plgs.cancel_lift" in drawn() and height_of(panel) == before
    follower.progress.stage, follower.progress.step = "train", 0
    assert "First step (may compile" in drawn() and height_of(panel) == before
    follower.kind = BAKE
    assert "are being baked" in drawn() and height_of(panel) == before
    follower.kind, follower.state, follower.is_running = LIFT, TaskState.CANCELLED, False
    assert "plgs.place_lift" in drawn() and height_of(panel) == before


def test_making_a_mesh_automatically_does_not_move_the_lists(tmp_path: Path) -> None:
    """It begins and ends when nobody expects it; it fails in sight."""
    lift = tiny_lift.write_tiny_lift(tmp_path / "lift").path
    place_lift(lift, bpy.context.scene)
    before, heads = drawn(), rows_above("Points, confidence")
    assert "plgs.make_meshes Surface" in before
    follower: Any = Pretended(TaskState.RUNNING)
    making = registry.follow(Export(lift, "surface", lift, bpy.context.scene.name, follower, asked=False))
    shown = drawn()
    assert "Surface 50 %" in shown and "plgs.cancel_export" in shown and "plgs.make_meshes Surface" not in shown
    assert abs(rows_above("Points, confidence") - heads) <= 1, "a bar and its cross are in the place of the button"
    follower.state, follower.is_running, making.is_taken = TaskState.FAILED, False, True
    follower.error = PlgsError("made-up", "is full", "the disk", "Make room.")
    shown = drawn()
    assert rows_above("Points, confidence") == heads
    assert "The disk is full. Make room." in shown.partition("plgs.show_all")[2].partition("Source Masks")[0]


def test_corrections_do_not_move_any_button(tmp_path: Path) -> None:
    lift = tiny_lift.write_tiny_lift(tmp_path / "lift").path
    place_lift(lift, bpy.context.scene)
    (root,) = lifts_in(bpy.context.scene)
    before = rows_above("plgs.undo_correction")
    split = rows_above("plgs.split_by_views")
    registry.follow(SplitByViews(lift, Pretended(TaskState.RUNNING), ()))  # type: ignore[arg-type]
    assert rows_above("Views 50 %") == split == rows_above("plgs.cancel_split") - 1
    one = proposals.Proposal(1, "chair 1", 1.0, "few frames saw it", "delete")
    root[proposals.PROPOSALS] = json.dumps({"open": [asdict(one)], "progress": "0 of 1 corrected or accepted"})
    shown = drawn()
    assert "few frames saw it" in shown
    assert rows_above("plgs.undo_correction") == before + 1, "the cross that cancels is beside the bar, in the same row"


@pytest.mark.parametrize(
    ("form", "shown_in", "button", "bar"),
    [
        ("coco", "", "plgs.export_lift COCO Panoptic", "COCO Panoptic 50 %"),
        ("surface", "", "plgs.export_lift Surface", "Surface 50 %"),
        ("surface", "Scene", "plgs.make_meshes\n", "Meshes 50 %"),
        ("clouds", "Scene", "plgs.make_depth_cloud", "Cloud 50 %"),
    ],
)
@pytest.mark.parametrize("asked", [True, False])
def test_an_export_shows_its_progress_bar(
    form: str, shown_in: str, button: str, bar: str, asked: bool, tmp_path: Path
) -> None:
    """The other buttons stay in sight, and where they are: what the export tells comes below the last one."""
    idle, last = drawn(), f"plgs.export_lift {[*FORMS.values()][-1][0]}"
    follower: Any = Pretended(TaskState.RUNNING)
    export = registry.follow(Export(tmp_path, form, tmp_path, shown_in, follower, asked=asked))
    shown = drawn()
    at = idle.partition(button)[0].count("\n")
    assert shown.split("\n")[at] == bar and button not in shown and shown.split("\n")[at + 1] == "plgs.cancel_export"
    assert idle.partition(button)[2].partition(last)[0].partition("\n")[2] in shown and "meshes are" not in shown
    assert shown.index(last) < shown.index("2/3  Half of it") and shown.index(last) < shown.index("1 min 30 s left")
    follower.state, follower.is_running, export.is_taken = TaskState.CANCELLED, False, True
    assert drawn().partition(last)[0] == idle.partition(last)[0] and "The export was cancelled" in drawn()


def test_buttons_for_frames_do_not_move(tmp_path: Path) -> None:
    """The best view, a mask, a proposal: each makes a frame's camera the active one, which has pictures to choose."""
    scene = bpy.context.scene
    place_lift(tiny_lift.write_tiny_lift(tmp_path / "lift").path, scene)
    scene.camera = next(ob for ob in scene.objects if ob.type == "CAMERA" and "frame" not in ob)
    before = rows_above("plgs.go_to_best_view")
    scene.camera = next(ob for ob in scene.objects if "frame" in ob)
    assert rows_above("plgs.go_to_best_view") == before


def test_only_one_picture_of_a_frame_is_made_at_a_time(tmp_path: Path) -> None:
    """A button that is grey while the mouse is on it stays so in Blender, although it may be pressed again."""
    scene = bpy.context.scene
    place_lift(tiny_lift.write_tiny_lift(tmp_path / "lift").path, scene)
    scene.camera = next(ob for ob in scene.objects if "frame" in ob)
    making = tasks_with(Pretended(TaskState.RUNNING), tmp_path)[1]
    registry.follow(making)
    assert bpy.ops.plgs.show_picture.poll()
    with pytest.raises(RuntimeError, match=worded("at-work")):
        bpy.ops.plgs.show_picture(what="PHOTO")
