"""From the panel to a lift: what is refused, and the advice that comes with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import plgs
import pytest
from plgs.engine.job import ExitCode, JobError, LiftFolder, LiftRequest
from plgs.engine.job.follower import Outcome
from plgs.engine.job.made_frames import MadeFrames
from plgs.plgs_blender.running import lifts, start
from plgs.plgs_blender.settings import adopt, place_of, request_of, shown_preset, why_no_options


@pytest.fixture(autouse=True)
def extension() -> Iterator[None]:
    plgs.register()
    yield
    lifts.let_go()
    plgs.unregister()


def test_what_to_do_about_a_lift_that_is_running(tmp_path: Path) -> None:
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "room"))
    scene = bpy.context.scene
    with lift.lock():
        with pytest.raises(JobError, match="it is running") as refused:
            start.resume_lift(scene.plgs, str(lift.path))
        assert refused.value.fix == "Watch it, or cancel it first."
        with pytest.raises(JobError, match="still running"):
            start.show_lift(scene, str(lift.path))
    with pytest.raises(JobError, match="not finished") as refused:
        start.show_lift(scene, str(lift.path))
    assert "Resume" in refused.value.fix


def test_advice_names_the_panels_fields(tmp_path: Path) -> None:
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "room"))
    watch = lifts.attach(lift.path)
    watch.follower.outcome = Outcome(ExitCode.BAD_INPUT, "it does not fit. Lift with --frames 40")
    assert lifts.message_for(watch) == "it does not fit. Lift with Frames 40"


def test_the_panel_chooses_the_device(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder, settings.device = str(tmp_path), "cuda"
    request = request_of(settings)
    assert request.device == "cuda"
    settings.device = "cpu"
    adopt(settings, request, tmp_path / "lift")
    assert settings.device == "cuda"


def test_all_options_of_the_preset() -> None:
    settings = bpy.context.scene.plgs
    settings.preset_options = "weights.depth=0  objects=boxes"
    assert why_no_options(settings) is None
    changed = [(name, value) for name, value, is_changed in shown_preset(settings) if is_changed]
    assert changed == [("objects", "boxes"), ("weights.depth", "0.0")]
    settings.preset_options = "weights.dept=0"
    assert "Did you mean weights.depth" in str(start.why_no_lift(settings))
    assert not any(is_changed for _, _, is_changed in shown_preset(settings))


def test_options_with_a_place_of_their_own_are_taken(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder = str(tmp_path)
    settings.preset_options = "steps=600 size_within=100,80 most_frames=9 weights.depth=0"
    asked = request_of(settings)
    assert (asked.steps, asked.size, asked.frames, asked.options) == (600, (100, 80), 9, {"weights.depth": 0.0})
    settings.steps, settings.frames = 7, -1
    assert (request_of(settings).steps, request_of(settings).frames) == (7, 0), "fields win"


def test_a_lift_is_asked_for_again_as_it_was(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    for frames in (None, 0, 12):
        asked = LiftRequest(
            tmp_path,
            steps=600,
            frames=frames,
            fit=True,
            mask_format="sam2",
            classes="coco",
            options={"steps_a_view": 5.0},
        )
        adopt(settings, asked, tmp_path / "lift")
        assert request_of(settings) == asked


def test_masks_are_read_alike_by_the_survey_and_the_lift(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder, settings.mask_format = str(tmp_path), "coco"
    settings.classes_table = str(tmp_path / "mine.toml")
    place, asked = place_of(settings), request_of(settings)
    table = str(tmp_path / "mine.toml")
    assert (place.mask_format, place.classes) == (asked.mask_format, asked.classes) == ("coco", table)
    told = [str(each) for each in place.arguments()]
    assert told[-4:] == ["--mask-format", "coco", "--classes", table]
    made = MadeFrames(tmp_path, place.resolved)
    made.write()
    assert MadeFrames.read(tmp_path).source == place.resolved
