"""Starting, watching, cancelling and resuming from a script, where operators wait for the lift."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from plgs.engine.job import EventWriter, LiftFolder
from plgs.engine.job.recent import remember_lift
from plgs.plgs_blender import engine_environment, registry
from plgs.plgs_blender.engine_environment import choices
from plgs.plgs_blender.running import lifting, lifts, survey

from tests.raises_key import raises_key, worded

ENGINE = Path(__file__).resolve().parents[1] / "job" / "fake_engine.py"
Behaves = Callable[[str], None]


@pytest.fixture
def behaves(monkeypatch: pytest.MonkeyPatch) -> Behaves:
    """Chooses what the engine's lift does."""
    monkeypatch.setattr(engine_environment, "usable_python", lambda: Path(sys.executable))

    def choose(behaviour: str) -> None:
        def command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
            return [python, ENGINE, behaviour, lift, *(["--resume"] if resume else [])]

        monkeypatch.setattr(lifts, "engine_command", command)

    return choose


def test_the_lift_operator_in_a_script_waits_for_the_lift(behaves: Behaves, room: Path, tmp_path: Path) -> None:
    behaves("short")
    settings = bpy.context.scene.plgs
    settings.place_when_done = False  # a pretended lift has nothing to show
    made = bpy.ops.plgs.lift_scene(
        scene_folder=str(room), lift_folder=str(tmp_path / "lift"), preset="standard", steps=7, seed=3
    )
    assert made == {"FINISHED"}
    request = LiftFolder.open(tmp_path / "lift").request
    assert (request.scene, request.preset, request.options, request.seed) == (room, "standard", {"steps": 7}, 3)
    assert (settings.preset, settings.steps, settings.seed) == ("standard", 7, 3), "the panel shows what is lifted"


def test_a_lift_without_a_chosen_folder_goes_beside_the_scene(behaves: Behaves, room: Path, tmp_path: Path) -> None:
    behaves("short")
    own = shutil.copytree(room, tmp_path / "room")
    bpy.context.scene.plgs.place_when_done = False
    bpy.ops.plgs.lift_scene(scene_folder=str(own))
    assert Path(bpy.context.scene.plgs.lift_folder) == tmp_path / "room_lift"
    bpy.ops.plgs.lift_scene()
    assert Path(bpy.context.scene.plgs.lift_folder) == tmp_path / "room_lift_2", "no lift is overwritten"


def test_a_cancelled_lift_is_resumed_by_the_operator(behaves: Behaves, room: Path, tmp_path: Path) -> None:
    behaves("broken")
    bpy.context.scene.plgs.place_when_done = False
    with pytest.raises(RuntimeError, match="no such luck|ZeroDivisionError"):
        bpy.ops.plgs.lift_scene(scene_folder=str(room), lift_folder=str(tmp_path / "lift"))
    broken = lifts.lift_of(tmp_path / "lift")
    assert broken is not None and broken.can_be_resumed
    assert broken.error is not None and broken.follower.log_lines, "the panel shows the log's end"
    behaves("short")
    assert bpy.ops.plgs.resume_lift(lift_folder=str(tmp_path / "lift")) == {"FINISHED"}
    with pytest.raises(RuntimeError, match=worded("not-resumable finished")):
        bpy.ops.plgs.resume_lift()


def test_a_draft_is_refined_to_preview_or_to_the_panels_preset(behaves: Behaves, room: Path, tmp_path: Path) -> None:
    behaves("short")
    settings = bpy.context.scene.plgs
    settings.place_when_done = False
    for chosen, expected in (("draft", "preview"), ("standard", "standard")):
        folder = tmp_path / expected
        bpy.ops.plgs.lift_scene(scene_folder=str(room), lift_folder=str(folder), preset="draft")
        settings.preset = chosen
        assert bpy.ops.plgs.refine_lift() == {"FINISHED"}
        assert LiftFolder.open(folder).request.preset == settings.preset == expected
        with pytest.raises(RuntimeError, match=worded("no-draft")):
            bpy.ops.plgs.refine_lift()


def test_a_lift_whose_scene_is_missing_is_placed_and_can_find_it(lift: Path, tmp_path: Path) -> None:
    own = shutil.copytree(lift, tmp_path / "deep" / "own")
    asked = json.loads((own / "request.json").read_text())
    asked |= {"scene": str(tmp_path / "gone"), "relative": {}}
    (own / "request.json").write_text(json.dumps(asked))
    assert bpy.ops.plgs.place_lift(lift_folder=str(own)) == {"FINISHED"}
    frames = [ob for ob in bpy.context.scene.objects if ob.type == "CAMERA" and "frame" in ob]
    assert frames and not any(ob.data.background_images for ob in frames)
    followed = lifts.attach(own)
    assert not followed.scene_is_there
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.plgs.find_scene(filepath=str(tmp_path / "nowhere"), lift_folder=str(own))
    room = shutil.copytree(lift.parent / "tiny room", tmp_path / "found")
    assert bpy.ops.plgs.find_scene(filepath=str(room), lift_folder=str(own)) == {"FINISHED"}
    found = lifts.lift_of(own)
    assert found is not None and found.scene_is_there
    assert all(ob.data.background_images for ob in frames), "the photos are there again"


def test_lifting_a_bad_scene_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=worded("no-format")):
        bpy.ops.plgs.lift_scene(scene_folder=str(tmp_path), lift_folder=str(tmp_path / "lift"))
    assert not (tmp_path / "lift").exists()


@pytest.mark.parametrize(
    ("how", "events_of_bake"), [("watch", 0), ("open", 0), ("open after a bake", 0), ("open after a bake", 20_000)]
)
def test_a_watched_or_opened_lift_is_placed(how: str, events_of_bake: int, lift: Path, tmp_path: Path) -> None:
    """Events of a real lift are too many to be read at once."""
    if how == "open after a bake":
        lift = shutil.copytree(lift, tmp_path / "lift")
        events = EventWriter(lift / "events.jsonl")
        events.hello(task="bake", threads=1, resumed=False)
        for step in range(events_of_bake):
            events.metric("step", {"number": step})
        events.done("finished")
        events.close()
    if how == "watch":
        assert bpy.ops.plgs.watch_lift(lift_folder=str(lift)) == {"FINISHED"}
    else:
        assert bpy.ops.plgs.open_lift(directory=str(lift)) == {"FINISHED"}
    assert any(ob.type == "POINTCLOUD" for ob in bpy.context.scene.objects)
    assert Path(bpy.context.scene.plgs.scene_folder) == LiftFolder.open(lift).request.scene


def test_opening_a_saved_file_finds_its_lift_again(lift: Path, tmp_path: Path) -> None:
    remember_lift(lift)
    reopen_with(lift, tmp_path)
    found = lifts.lift_of(lift)
    assert found is not None and found.is_finished


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")
def test_opening_somebody_elses_blend_file_reads_none_of_its_paths(
    lift: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    os.mkfifo(theirs / "request.json")
    os.mkfifo(theirs / "events.jsonl")
    bpy.context.scene.plgs.scene_folder = ""
    looked: list[object] = []
    monkeypatch.setattr(survey, "look", lambda place, python: looked.append(place))
    bpy.context.scene.plgs.scene_folder = str(theirs)
    looked.clear()
    reopen_with(theirs, tmp_path / "other" / "place")
    assert lifts.lift_of(theirs) is None and theirs not in lifts.refusals and looked == []
    with pytest.raises(RuntimeError, match=worded("foreign-file")):
        bpy.ops.plgs.watch_lift()


def reopen_with(folder: Path, tmp_path: Path) -> None:
    bpy.context.scene.plgs.lift_folder = str(folder)
    tmp_path.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    registry.forget_all()
    lifts.refusals.clear()
    lifts.nothing_there.clear()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "file.blend"))


def test_cancelling_a_lift_that_is_not_running_says_so(lift: Path) -> None:
    with pytest.raises(RuntimeError, match=worded("no-lift")):
        bpy.ops.plgs.cancel_lift()
    with pytest.raises(RuntimeError, match=worded("not-running finished")):
        bpy.ops.plgs.cancel_lift(lift_folder=str(lift))
    assert not (lift / "cancel").exists()


def test_a_script_cannot_lift_into_the_folder_of_another_lift(behaves: Behaves, room: Path, tmp_path: Path) -> None:
    behaves("short")
    bpy.context.scene.plgs.place_when_done = False
    bpy.ops.plgs.lift_scene(scene_folder=str(room), lift_folder=str(tmp_path / "lift"))
    with pytest.raises(RuntimeError, match=worded("holds-lift")):
        bpy.ops.plgs.lift_scene(lift_folder=str(tmp_path / "lift"))


def test_lifting_a_scene_again_keeps_the_names_of_its_objects(behaves: Behaves, lift: Path, tmp_path: Path) -> None:
    behaves("short")
    settings = bpy.context.scene.plgs
    bpy.ops.plgs.place_lift(lift_folder=str(lift))
    settings.place_when_done = False
    for number, (given, expected) in enumerate(
        [({}, lift), ({"keep_names": False}, None), ({"names_from": str(tmp_path / "other")}, tmp_path / "other")]
    ):
        bpy.ops.plgs.lift_scene(lift_folder=str(tmp_path / f"again {number}"), **given)
        assert LiftFolder.open(tmp_path / f"again {number}").request.names_from == expected


def test_studio_defaults_fill_in_untouched_fields_of_the_panel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = bpy.context.scene.plgs
    settings.device = "cpu"
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    file = tmp_path / "plgs.toml"
    file.write_text('preset = "standard"\nmasks = "masks/{scene}"\ndevice = "auto"\n')
    monkeypatch.setenv("PLGS_DEFAULTS", str(file))
    for name in ("a", "b"):
        settings.scene_folder = str(tmp_path / name)
        assert settings.masks == str(tmp_path / "masks" / name)
    assert settings.preset == "standard" and settings.device == "cpu"
    file.write_text("quality = 1\n")
    with raises_key("unknown-field plgs.toml"):
        lifting.start_lift(settings)


def test_studio_defaults_can_be_named_in_preferences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "plgs.toml"
    file.write_text('device = "auto"\n')
    monkeypatch.setenv("PLGS_DEFAULTS", "")
    monkeypatch.setattr(choices, "_choices", lambda: SimpleNamespace(defaults_file=str(file)))
    bpy.context.scene.plgs.scene_folder = str(tmp_path)
    assert bpy.context.scene.plgs.device == "auto" and os.environ["PLGS_DEFAULTS"] == str(file)
    monkeypatch.setattr(choices, "_choices", lambda: SimpleNamespace(defaults_file=""))
    assert engine_environment.studio().file is None
