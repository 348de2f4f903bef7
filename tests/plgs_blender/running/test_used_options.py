"""Fields that leave a value to the preset show the value that a lift will use."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import bpy
import plgs
import pytest
from plgs.engine.presets.preset import PRESETS
from plgs.plgs_blender.running import estimate
from plgs.plgs_blender.settings import request_of


@pytest.fixture
def shown() -> Iterator[bpy.types.PropertyGroup]:
    plgs.register()
    yield bpy.context.scene.plgs_used
    plgs.unregister()


def values(shown: bpy.types.PropertyGroup) -> tuple[int, ...]:
    return tuple(getattr(shown, name) for name in estimate.NAMES)


def test_without_a_scene_they_are_the_presets(shown: bpy.types.PropertyGroup) -> None:
    for name, preset in PRESETS.items():
        bpy.context.scene.plgs.preset = name
        assert values(shown) == (preset.steps, *preset.size, preset.frames)


def test_of_a_known_scene_they_are_what_the_lift_takes(
    shown: bpy.types.PropertyGroup, monkeypatch: pytest.MonkeyPatch
) -> None:
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
