"""Every panel draws in every state: nothing chosen, a task that runs, one that failed, a finished lift."""

import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import pytest
import tiny_lift
from plgs.engine.errors import ErrorCode, PlgsError, lacks_part
from plgs.engine.job import LiftState
from plgs.engine.job.task import BAKE, TaskState
from plgs.operators import masks
from plgs.plgs_blender import registry
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.engine_environment import choices, tasks
from plgs.plgs_blender.inspecting import drawing
from plgs.plgs_blender.lift_scene import place_lift
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.running import adding, lifts, survey
from plgs.plgs_blender.running.preparation import FilmMaking, PoseMaking
from plgs.plgs_blender.settings import chosen_scene
from plgs.ui import lift_panel, result_panel, sidebar
from pretended_python import pretended_python

from tests.ui.drawn_panels import Layout, Pretended, drawn, followed_lift, tasks_with

pytestmark = pytest.mark.usefixtures("extension")


def test_text_of_an_unknown_file_is_shown_as_printable_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files, folders and logs may hold characters that reverse or break a line, or command a terminal."""
    odd = "a\u202eb\u2028c\x1b[31md"
    lift = tiny_lift.write_tiny_lift(tmp_path / odd).path
    settings = bpy.context.scene.plgs
    settings.lift_folder = str(lift)
    place_lift(lift, bpy.context.scene)
    root = lifts_in(bpy.context.scene)[0]
    root.name, bpy.context.scene.camera.name = f"lift {odd}", f"camera {odd}"
    unshown = root.plgs.not_shown.add()
    unshown.name, unshown.frame = odd, odd
    for row in (*root.plgs.instances, *root.plgs.classes):
        row.name = odd
    for row in root.plgs.instances:
        row.masks.add()
        for mask in row.masks:
            mask.frame = mask.class_name = mask.reason = odd
    root.plgs.instance_index = 0
    followed = lifts.lift_of(lift)
    follower: Any = Pretended(TaskState.FAILED, PlgsError("made-up", "is bad", odd, odd))
    follower.log_lines = (odd,)
    follower.progress.label = odd
    followed.follower = follower
    monkeypatch.setattr(lifts, "recent", [SimpleNamespace(folder=followed.folder, state=LiftState.FINISHED)])
    seen = drawn().split("\n")
    follower.state, follower.is_running = TaskState.RUNNING, True
    seen += drawn().split("\n")
    settings.lift_folder = ""  # the lift goes on beside the panel's
    seen += drawn().split("\n")
    layout, rows = Layout(seen), root.plgs.instances
    result_panel.PLGS_UL_instances.draw_item(None, None, layout, root.plgs, rows[0], 0, None, "")
    result_panel.PLGS_UL_classes.draw_item(None, None, layout, root.plgs, root.plgs.classes[0], 0, None, "")
    result_panel.PLGS_UL_masks.draw_item(None, None, layout, rows[0], rows[0].masks[0], 0, None, "", 0)
    seen += [name for name, _ in drawing.shown_classes(root.plgs.classes)]
    assert [line for line in seen if not line.isprintable()] == []
    assert sum("a?b?c?[31md" in line for line in seen) >= 15


def test_the_panel_shows_progress_of_a_lift_of_another_blender(tmp_path: Path) -> None:
    _, follower = followed_lift(tmp_path / "lift")
    follower.progress.began, follower.progress.left_s = time.time() - 300.0, 100.0
    shown = drawn()
    assert "All: 75 %" not in shown and "Loss" not in shown, "one bar, one number"
    bar = shown.index("75 %, 1 min 40 s left")
    assert shown.index("Stage 2 of 3: lift, ") < shown.index("Half of it, loss 0.5000") < bar
    assert bar < shown.index("plgs.cancel_lift")


def test_texts_that_are_cut_in_the_panel_end_with_a_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a sidebar as wide as Blender opens it, where the rows of a lift are one line high."""
    estimate = SimpleNamespace(seconds=3580.0, peak_bytes=110.4e9)
    monkeypatch.setattr(lift_panel, "estimate_of", lambda settings: estimate)
    assert "About 59 min 40 s, 110.4 GB memory" in drawn(width=280)
    _, follower = followed_lift(tmp_path / "a lift of the long name of a room")
    follower.progress.stage, follower.progress.step = "train", 0
    shown = drawn(width=280)
    assert "Stage 2 of 3: a lift of the long…" in shown and "First step (may compile for 2 min)" in shown


def test_the_panel_without_a_scene_offers_to_choose_one() -> None:
    shown = drawn()
    assert "Choose a capture's folder" in shown and "plgs.lift_scene" in shown and "plgs.set_up_engine" in shown


@pytest.mark.parametrize("code", ErrorCode)
def test_the_panel_shows_how_to_fix_a_bad_scene(code: ErrorCode, tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    for task in tasks_with(
        Pretended(
            TaskState.FAILED, PlgsError("made-up", "is bad", "here", "Give --masks.", code=code, option="--masks")
        ),
        tmp_path,
    ):
        task.is_taken = True
        registry.follow(task)
    shown = drawn()
    assert shown.count("here is bad. Give Masks.") == 4
    assert "set-up.log" in shown and ("plgs.show_preferences" in shown) >= (code is ErrorCode.NO_ENGINE)


def test_a_missing_package_shows_the_button_that_adds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an environment that lacks a package of one button: that button is grey, the others are not."""
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    assert "plgs.add_to_engine" not in drawn()
    choices.choose(pretended_python(tmp_path / "python", lacks="segment"))
    try:
        registry.wait_for(tasks.check(), bpy.context.scene)  # type: ignore[arg-type]
    finally:
        choices.choose(None)
    shown = drawn()
    assert shown.count("Make Masks: the engine lacks a-package") == 2, "in the panel and in the preferences"
    assert "Add to Engine (130 MB)" in shown and "Allow online access" in shown
    assert shown.count("plgs.check_engine") == 3, "beside each of these, and in the preferences"
    with pytest.raises(RuntimeError, match="Allow online access"):
        bpy.ops.plgs.add_to_engine(capability="segment")
    panel = SimpleNamespace(plgs_panel=bpy.context.scene.plgs, scene=bpy.context.scene)
    assert masks.PLGS_OT_make_masks.why_not(panel) == adding.why_lacking("segment") is not None
    assert masks.PLGS_OT_diagnose.why_not(panel) is None
    registry.follow(adding.Adding("segment", Pretended(TaskState.RUNNING)))  # type: ignore[arg-type]
    shown = drawn()
    assert "plgs.cancel_adding" in shown and "plgs.add_to_engine" not in shown


def test_an_engine_error_about_a_missing_package_shows_its_button(tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    error = lacks_part("Record3D's depth needs the package pyliblzfse", "here", "record3d")
    task = tasks_with(Pretended(TaskState.FAILED, error), tmp_path)[0]
    task.is_taken = True
    registry.follow(task)
    assert "Add to Engine (1 MB)" in drawn()


def test_the_panel_shows_what_a_film_needs_to_download(tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(tmp_path / "film.mp4")
    follower: Any = Pretended(TaskState.RUNNING)
    registry.follow(FilmMaking(chosen_scene(bpy.context.scene.plgs), follower))
    shown = drawn()
    assert "Half of it" in shown and "plgs.cancel_film" in shown and "plgs.make_poses" not in shown
    what = "this must be downloaded first: packages: 134 MB; network: 60 MB"
    follower.error = PlgsError("lacks-parts", what, "film.mp4", "", code=ErrorCode.LACKS_PART, option="colmap")
    follower.state, follower.is_running = TaskState.FAILED, False
    registry.latest(FilmMaking).is_taken = True  # type: ignore[union-attr]
    shown = drawn()
    assert "downloaded first: packages: 134 MB" in shown and "Add to Engine (" in shown
    assert any(line.startswith("network: 60 MB") for line in shown.splitlines()), "a line each"


def test_photos_without_poses_show_the_button_that_finds_poses(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.jpg").touch()
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    chosen = chosen_scene(bpy.context.scene.plgs)
    survey.look(chosen, Path(sys.executable))
    registry.wait_for(registry.latest(survey.SceneLook), bpy.context.scene)  # type: ignore[arg-type]
    shown = drawn()
    assert "let COLMAP find the poses with Find Poses." in shown and "plgs.make_poses" in shown
    registry.follow(PoseMaking(chosen, Pretended(TaskState.RUNNING)))  # type: ignore[arg-type]
    assert "plgs.cancel_poses" in drawn()


def test_running_tasks_show_their_progress(tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    for task in tasks_with(Pretended(TaskState.RUNNING), tmp_path):
        registry.follow(task)
    shown = drawn()
    assert shown.count("2/3  Half of it, loss 0.5000") == 3 and "Images 50 %" in shown and "COCO Panoptic 50 %" in shown
    assert shown.count("5 of 10, 1 min 30 s left") == 2 and shown.count("50 %, 1 min 30 s left") == 1
    for name in ("masks", "frames", "export", "engine_set_up"):
        assert f"plgs.cancel_{name}" in shown


@pytest.mark.parametrize(
    ("step", "left_s", "ago_s", "expected"),
    [
        (5, None, 0.0, (0.5, "5 of 10, 1 min 30 s left")),
        (10, None, 0.0, (1.0, "40 s")),  # the stage goes on: what it counts is done
        (0, None, 0.0, (0.0, "40 s")),
        (5, 60.0, 0.0, (0.4, "40 %, 1 min 00 s left")),
        (10, 60.0, 20.0, (0.5, "50 %, 40 s left")),  # counted down without news
        (10, 60.0, 90.0, (1.0, "Almost done")),
    ],
)
def test_the_progress_bar_shows_the_share_of_the_expected_time(
    step: int, left_s: float | None, ago_s: float, expected: tuple[float, str], tmp_path: Path
) -> None:
    task = tasks_with(Pretended(TaskState.RUNNING), tmp_path)[0]
    task.progress.step, task.progress.left_s = step, left_s
    task.poll(bpy.context.scene)
    task._estimated_at -= ago_s
    task.began -= 40.0
    share, text = sidebar.how_far(task)
    assert (round(share, 1), text) == expected


def test_the_panel_of_a_cancelled_lift_shows_resume_first(tmp_path: Path) -> None:
    followed, follower = followed_lift(tmp_path / "lift")
    follower.is_own = True
    assert lifts.stops_with_blender(bpy.context.scene) and bpy.ops.plgs.quit.poll()
    bpy.context.scene.plgs.keep_running = True
    assert not bpy.ops.plgs.quit.poll()
    bpy.context.scene.plgs.keep_running = False
    follower.state, follower.is_running, followed.lift_state = TaskState.CANCELLED, False, LiftState.CANCELLED
    followed.has_result = False
    shown = drawn()
    assert shown.index("plgs.resume_lift") < shown.index("plgs.lift_scene Start Anew") and not bpy.ops.plgs.quit.poll()
    assert "plgs.place_lift" not in shown
    followed.has_result = True  # the lift was lifted again, and has its earlier result
    assert "plgs.place_lift" in drawn()


def test_panels_of_earlier_steps_close_once_a_result_is_shown(tmp_path: Path) -> None:
    assert "plgs.lift_scene" in drawn(steps=False)
    place_lift(tiny_lift.write_tiny_lift(tmp_path / "lift").path, bpy.context.scene)
    folded = drawn(steps=False)
    assert "plgs.lift_scene" not in folded and "plgs.import_scene" not in folded and "Photo" in folded
    assert "plgs.lift_scene" in drawn()
    assert folded.lstrip().startswith("Turns a filmed room into named objects")


def test_the_class_other_is_listed_last() -> None:
    names = ("otherprop 1", "chair 10", "chair 2", "otherfurniture")
    rows = [SimpleNamespace(name=name, class_name=name, points=9 - at, score=0.5) for at, name in enumerate(names)]
    assert result_panel.places_of(rows, "NAME") == [3, 1, 0, 2]
    assert result_panel.places_of(rows, "COUNT") == [2, 0, 1, 3]


def test_the_panel_shows_a_finished_lift(tmp_path: Path) -> None:
    lift = tiny_lift.write_tiny_lift(tmp_path / "lift").path
    settings = bpy.context.scene.plgs
    settings.lift_folder = str(lift)
    shown = drawn()
    assert "The lift is finished" in shown and "plgs.place_lift" in shown
    place_lift(lift, bpy.context.scene)
    settings.scene_folder = str(ChosenScene(tmp_path / "tiny room").scene)
    shown = drawn()
    assert "plgs.isolate_instance" in shown and "plgs.bake_camera" in shown
    followed = lifts.lift_of(lift)
    followed.follower = Pretended(TaskState.RUNNING)
    assert "plgs.cancel_lift" in drawn() and "view3d.view_camera" in drawn()
    followed.follower.kind = BAKE
    shown = drawn()
    assert "plgs.cancel_lift" in shown and "view3d.view_camera" not in shown and "are being baked" in shown
