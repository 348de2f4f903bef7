"""What the lift that the panel is set to will take, and what it will use where the settings leave it to the preset."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import bpy
from bpy.props import IntProperty, PointerProperty

from ...engine.errors import PlgsError
from ...engine.job.prediction import USUAL_CLASSES, BakeCost, Prediction, machine_slowness, predict, predict_bake
from ...engine.posed import size_within
from ...engine.presets.options import with_options
from ...engine.presets.preset import PRESETS
from ..settings import PLGS_PG_settings, asked_of_preset, why_no_options
from .survey import survey_of_panel

_slowness = 1.0
"""How many times longer this computer takes than the one that the predictions were measured on."""


def learn_slowness() -> None:
    """Read from the disk how long earlier lifts took on this computer."""
    global _slowness
    _slowness = machine_slowness()


def bake_estimate(frames: int, size: tuple[int, int], layers: Collection[str]) -> BakeCost:
    """What it costs to bake these frames, of ``size`` (width, height) pixels, with further ``layers``, on this
    computer.
    """
    return predict_bake(frames, size, _slowness, layers)


def estimate_of(settings: PLGS_PG_settings) -> Prediction | None:
    """Time and memory of the lift that the settings ask for; None while the scene is not known, or the settings are
    wrong. Never reads the disk: panels call it.
    """
    survey = survey_of_panel(settings)
    if survey is None or survey.error is not None or not survey.sizes or why_no_options(settings):
        return None
    preset, options = asked_of_preset(settings)
    (size, _), *_ = survey.sizes
    return predict(
        survey.train_frames,
        survey.test_frames,
        size,
        with_options(PRESETS[preset], options),
        bake=settings.bake,
        slowness=_slowness,
        classes=len(survey.classes) or USUAL_CLASSES,
    )


NAMES = ("steps", "width", "height", "frames")
"""The settings for which 0 is the preset's value."""


@dataclass(frozen=True)
class UsedOptions:
    """Training steps, size of the frames in pixels, and number of frames to train on (0: all)."""

    steps: int
    width: int
    height: int
    frames: int


def used_options(settings: PLGS_PG_settings) -> UsedOptions:
    """What the lift will use, as far as it is known: without a survey, the preset's values. Never reads the disk."""
    try:
        name, options = asked_of_preset(settings)
    except PlgsError:
        name, options = settings.preset, {}
    preset = with_options(PRESETS[name], options)
    survey = survey_of_panel(settings)
    if survey is None or survey.error is not None or not survey.sizes:
        return UsedOptions(preset.steps, *preset.size, preset.frames)
    (size, _), *_ = survey.sizes
    views = preset.views_of(survey.train_frames)
    return UsedOptions(preset.for_views(views).steps, *size_within(size, preset.size), views)


def _used(name: str, description: str, least: int = 0, **kinds: str) -> IntProperty:
    """A property that shows what will be used. What is typed goes to the setting of its name."""

    def read(shown: PLGS_PG_used_options) -> int:
        return int(getattr(used_options(shown.id_data.plgs), name))

    def write(shown: PLGS_PG_used_options, value: int) -> None:
        setattr(shown.id_data.plgs, name, value)

    told = f"{description}. 0: the preset's"
    return IntProperty(name=name.capitalize(), description=told, get=read, set=write, min=least, **kinds)


class PLGS_PG_used_options(bpy.types.PropertyGroup):
    """`scene.plgs_used`: the real values behind the zeros of `scene.plgs`."""

    steps: _used("steps", "Training steps")  # type: ignore[valid-type]
    width: _used("width", "Frames are scaled to fit this width", subtype="PIXEL")  # type: ignore[valid-type]
    height: _used("height", "Frames are scaled to fit this height", subtype="PIXEL")  # type: ignore[valid-type]
    frames: _used(  # type: ignore[valid-type]
        "frames", "Train on at most this many frames, the sharpest of each stretch; -1: on all", least=-1
    )


CLASSES = (PLGS_PG_used_options,)


def register() -> None:
    bpy.types.Scene.plgs_used = PointerProperty(type=PLGS_PG_used_options)


def unregister() -> None:
    del bpy.types.Scene.plgs_used
