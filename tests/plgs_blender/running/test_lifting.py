"""From the panel to a lift: what is refused, and the advice that comes with it."""

import re
from pathlib import Path

import bpy
import pytest
from plgs.engine.errors import PlgsError
from plgs.engine.job import LiftFolder, LiftRequest
from plgs.engine.known_scene import MadeFrames, StoredScene
from plgs.plgs_blender.errors import field_of_option, with_field_names
from plgs.plgs_blender.running import lifting
from plgs.plgs_blender.settings import adopt, chosen_scene, request_of, shown_preset, why_no_options

from tests.raises_key import raises_key

pytestmark = pytest.mark.usefixtures("extension")


def test_the_panel_advises_to_wait_for_or_cancel_a_running_lift(tmp_path: Path) -> None:
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "room"))
    scene = bpy.context.scene
    with lift.lock():
        with raises_key("not-resumable") as refused:
            lifting.resume_lift(scene.plgs, str(lift.path))
        assert refused.value.fix == "Watch it, or cancel it first."
        with raises_key("still-running"):
            next(lifting.showing_lift(scene, str(lift.path)))
    with raises_key("not-finished") as refused:
        next(lifting.showing_lift(scene, str(lift.path)))
    assert "Resume" in refused.value.fix


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            "Lift with --frames 40 (--fit finds such a number), or with --size 320x240, or with --preset preview.",
            "Lift with Frames 40 (Fit Memory finds such a number), or with Width and Height 320x240, "
            "or with Preset preview.",
        ),
        ("Say which one it is, such as --mask-format coco.", "Say which one it is, such as Mask Format coco."),
        ("lift with --up -y", "lift with Up -y"),
        (
            "read it with --up z, or 'python -m engine inspect SCENE --fix OUT' writes a scene that is turned upright",
            "read it with Up z, or Fix writes a scene that is turned upright",
        ),
        ("/rooms/a--size 3/x--up", "/rooms/a--size 3/x--up"),
        ("--fits and --unheard-of", "--fits and --unheard-of"),
        ("let the command segment make them", "let Make Masks make them"),
        ("Make the result again: 'python -m engine lift LIFT --resume'.", "Press Resume."),
        ("Add it to the engine: '/a b/python' -m engine add colmap.", "Press Add to Engine."),
        ("Give --masks FOLDER: python -m engine segment SCENE makes them.", "Give Masks: Make Masks makes them."),
        (PlgsError("made-up", "is none", "/a/ --up b", "Give --classes."), "/a/ --up b is none. Give Classes."),
        (PlgsError("made-up", "there is none", "/a/--up", "Give --up."), "There is none: /a/--up. Give Up."),
        (PlgsError("made-up", "nothing is left", "", ""), "Nothing is left"),
        (PlgsError("made-up", "is it far?", "", "Look."), "Is it far? Look."),
        (PlgsError("made-up", "is full", "the disk", "Make room."), "The disk is full. Make room."),
        (PlgsError("made-up", "rgbd/3.jpg is missing", "a.r3d", ""), "rgbd/3.jpg is missing: a.r3d"),
        (PlgsError("made-up", "'chair' may be two", "", ""), "'chair' may be two"),
        (PlgsError("made-up", "depth_scale is not above 0", "a", ""), "depth_scale is not above 0: a"),
        (PlgsError("made-up", "a.png, b.png are gone", "a", ""), "a.png, b.png are gone: a"),
    ],
)
def test_advice_of_the_engine_names_the_panels_fields(said: str | PlgsError, told: str) -> None:
    assert with_field_names(said) == told


def test_every_option_named_in_an_error_has_a_name_in_the_panel(root: Path) -> None:
    """The options that the engine's errors declare, as far as the panel can start such a task."""
    files = [path for part in ("scene", "lift", "segment") for path in (root / "engine" / part).rglob("*.py")]
    texts = [path.read_text() for path in files]
    declared = {option for text in texts for option in re.findall(r'option="(--[a-z-]+)"', text)}
    of_commands = {"--download", "--resume"}
    assert {option for option in declared if field_of_option(option) is None} <= of_commands


def test_the_device_of_the_panel_is_requested_and_restored(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder, settings.device = str(tmp_path), "cuda"
    request = request_of(settings)
    assert request.device == "cuda"
    settings.device = "cpu"
    adopt(settings, request, tmp_path / "lift")
    assert settings.device == "cuda"


def test_the_options_of_a_preset_are_shown() -> None:
    settings = bpy.context.scene.plgs
    settings.preset_options = "weights.depth=0  objects=boxes"
    assert why_no_options(settings) is None
    changed = [(name, value) for name, value, is_changed in shown_preset(settings) if is_changed]
    assert changed == [("objects", "boxes"), ("weights.depth", "0.0")]
    settings.preset_options = "weights.dept=0"
    assert "Did you mean weights.depth" in str(lifting.why_no_lift(settings))
    assert not any(is_changed for _, _, is_changed in shown_preset(settings))


def test_preset_options_typed_in_the_panel_are_used(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder = str(tmp_path)
    settings.preset_options = "steps=600 size=100,80 frames=9 weights.depth=0"
    asked = request_of(settings)
    assert asked.options == {"steps": 600, "size": [100, 80], "frames": 9, "weights.depth": 0.0}
    settings.steps, settings.frames = 7, -1
    options = request_of(settings).options
    assert (options["steps"], options["frames"]) == (7, 0), "fields win"


def test_a_lift_is_requested_again_with_the_same_options(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    for frames in ({}, {"frames": 0}, {"frames": 12}):
        options = {"steps": 600, "steps_a_view": 5.0, **frames}
        asked = LiftRequest(tmp_path, options=options, fit=True, mask_format="sam2", classes="coco")
        adopt(settings, asked, tmp_path / "lift")
        assert request_of(settings) == asked


def test_the_panel_and_the_lift_read_masks_in_the_same_way(tmp_path: Path) -> None:
    settings = bpy.context.scene.plgs
    settings.scene_folder, settings.mask_format = str(tmp_path), "coco"
    settings.classes_table = str(tmp_path / "mine.toml")
    place, asked = chosen_scene(settings), request_of(settings)
    table = str(tmp_path / "mine.toml")
    assert (place.mask_format, place.classes) == (asked.mask_format, asked.classes) == ("coco", table)
    told = [str(each) for each in place.arguments()]
    assert told[-4:] == ["--mask-format", "coco", "--classes", table]
    made = MadeFrames(tmp_path, place.resolved, StoredScene(()))
    made.write()
    assert MadeFrames.read(tmp_path).source == place.resolved
