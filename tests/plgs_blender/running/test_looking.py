"""What Blender reads before anybody asks: the objects of an opened file's lift, and what is in the panel's scene."""

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from plgs.engine.corrections import correct, making
from plgs.engine.job.recent import remember_lift
from plgs.engine.presets.preset import PRESETS
from plgs.plgs_blender import corrections, lift_scene, results
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.inspecting.selection import find_lift
from plgs.plgs_blender.running import estimate, looking, survey
from plgs.plgs_blender.settings import request_of

from tests.ui.drawn_panels import drawn

pytestmark = pytest.mark.usefixtures("extension")
Read = list[Path]


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Read:
    """The instances.json of which a first part was read since a file was ``opened``."""
    paths, reading = [], results.reading_instances
    monkeypatch.setattr(results, "reading_instances", lambda path: (paths.append(path), reading(path))[1])
    monkeypatch.setattr(looking, "_PARTS_S", 0.0)  # an object in each part
    return paths


def opened(lift: Path, folder: Path, blend: str, read: Read, *, linked: bool = False) -> Path:
    """A copy of a lift in a newly opened file that shows it. If ``linked``, its list of objects lies elsewhere."""
    shutil.copytree(lift, folder)
    lift_scene.place_lift(folder, bpy.context.scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / blend))
    results._kept.clear()
    results._begun.clear()
    read.clear()
    if linked:
        listed = folder / "result" / "instances.json"
        listed.symlink_to(listed.rename(folder.with_suffix(".json")))
    bpy.ops.wm.open_mainfile(filepath=str(folder / blend))
    return folder


def test_opening_a_file_does_not_wait_for_its_lift_to_be_read(lift: Path, tmp_path: Path, read: Read) -> None:
    mine = opened(lift, tmp_path / "mine", "lift.blend", read)
    assert not read, "not while the file is opened"
    parts = 0
    while looking._read_objects() is not None:
        parts += 1
    assert parts == 2 and looking._read_objects() is None
    corrections.delete(find_lift(bpy.context.scene), 2, around=False)
    assert read == [mine / "result" / "instances.json"]


def test_lift_paths_in_a_file_are_read_only_if_they_are_the_users(lift: Path, tmp_path: Path, read: Read) -> None:
    (tmp_path / "else" / "where").mkdir(parents=True)
    mine = opened(lift, tmp_path / "mine", "../else/where/film.blend", read)
    assert looking._read_objects() is None and not read
    remember_lift(mine)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "else" / "where" / "film.blend"))
    assert looking._read_objects() is not None and len(read) == 1


@pytest.mark.parametrize("change", ["nothing", "corrections", "result"])
def test_a_lift_that_changed_since_the_file_was_saved_is_reported(change: str, lift: Path, tmp_path: Path) -> None:
    mine = opened(lift, tmp_path / "mine", "lift.blend", [])
    assert "Show It Anew" not in drawn()
    if change == "corrections":  # as a command does
        correct(mine, lambda state, _: making.rename(state, 1, "throne"))
    elif change == "result":
        listed = mine / "result" / "instances.json"
        listed.write_text(listed.read_text().replace('"chair', '"stool'))
    bpy.ops.wm.open_mainfile(filepath=str(mine / "lift.blend"))
    assert ("Show It Anew" in drawn()) is ("on disk differs" in drawn()) is (change != "nothing")
    names = {row.name for row in find_lift(bpy.context.scene).plgs.instances}
    assert "throne" not in names, "unasked"
    if change == "corrections":
        corrections.rename(find_lift(bpy.context.scene), 2, "bench")
        names = {row.name for row in find_lift(bpy.context.scene).plgs.instances}
        assert {"throne", "bench"} <= names and "Show It Anew" not in drawn()


def test_a_link_in_place_of_the_lift_is_not_followed(lift: Path, tmp_path: Path, read: Read) -> None:
    opened(lift, tmp_path / "mine", "lift.blend", read, linked=True)
    assert looking._read_objects() is None and not read


@pytest.mark.parametrize("name", ["a" * 300, "a\0b", "a\ud800b"], ids=["long", "null", "surrogate"])
def test_impossible_paths_are_reported(tmp_path: Path, name: str) -> None:
    for chosen in (ChosenScene(tmp_path / name, None, "z"), ChosenScene(tmp_path, tmp_path / name, "z")):
        seen = survey.look(chosen, None)
        assert seen.error is not None and seen.error.fix and not seen.is_looking
    if name.isascii() and "\0" in name:  # no program can be told it
        assert survey.look(ChosenScene(tmp_path / name, None, "z"), Path(sys.executable)).error


@pytest.fixture
def shown() -> bpy.types.PropertyGroup:
    return bpy.context.scene.plgs_used


def values(shown: bpy.types.PropertyGroup) -> tuple[int, ...]:
    return tuple(getattr(shown, name) for name in estimate.NAMES)


def test_without_a_scene_the_panel_shows_the_presets_options(shown: bpy.types.PropertyGroup) -> None:
    for name, preset in PRESETS.items():
        bpy.context.scene.plgs.preset = name
        assert values(shown) == (preset.steps, *preset.size, preset.frames)


def test_the_panel_adapts_options_to_a_scene(shown: bpy.types.PropertyGroup, monkeypatch: pytest.MonkeyPatch) -> None:
    known = SimpleNamespace(error=None, sizes=[((640, 480), 300)], train_frames=300)
    monkeypatch.setattr(estimate, "survey_of_panel", lambda settings: known)
    settings = bpy.context.scene.plgs
    settings.scene_folder = "/room"
    preset = PRESETS["preview"]
    assert values(shown) == (round(300 * preset.steps_a_view), 200, 150, 300)
    shown.frames, shown.height = 50, 240
    assert (settings.frames, settings.height) == (50, 240)
    assert values(shown) == (preset.steps, 320, 240, 50)
    shown.steps = 77
    assert values(shown) == (77, 320, 240, 50) and request_of(settings).options["steps"] == 77
    settings.steps = settings.frames = settings.height = 0
    assert values(shown) == (round(300 * preset.steps_a_view), 200, 150, 300), "0 leaves it to the preset"
