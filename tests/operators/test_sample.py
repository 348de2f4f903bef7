"""The sample room that comes with the extension, and what an engine that becomes ready looks at again."""

from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender.engine_environment import tasks
from plgs.plgs_blender.running import looking, survey


def test_the_sample_is_imported_from_a_copy_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert bpy.ops.plgs.try_sample(cloud=False) == {"FINISHED"}
    folder = tmp_path / "PLGS Sample" / "room"
    assert bpy.context.scene.plgs.scene_folder == str(folder)
    assert sum("frame" in ob for ob in bpy.context.scene.objects) == 72
    assert not (folder / "gt").exists() and (folder / "LICENSE").is_file()
    (folder / "mine.txt").touch()
    assert bpy.ops.plgs.try_sample(cloud=False) == {"FINISHED"} and (folder / "mine.txt").exists(), "the same copy"


def test_a_chosen_scene_is_read_again_when_the_engine_is_ready(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    bpy.context.scene.plgs.scene_folder = str(room)
    assert survey.survey_of_panel(bpy.context.scene.plgs).has_masks is None, "Blender alone cannot tell"
    monkeypatch.setattr(looking, "look_at_scene", looked.append)
    for listener in tasks.when_ready:
        listener()
    assert [each.scene for each in looked] == [room]


def test_a_missing_engine_is_explained_by_a_running_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    from plgs.plgs_blender import engine_environment

    missing = tasks.EngineStatus(tasks.EngineState.MISSING, "There is no Python", "Press Set Up Engine.")
    monkeypatch.setattr(engine_environment, "status", lambda: missing)
    assert "Press Set Up Engine" in engine_environment.why_no_engine()
    monkeypatch.setattr(engine_environment, "running_set_up", object)
    assert "being set up" in engine_environment.why_no_engine()
