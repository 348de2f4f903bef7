"""The estimated cost of the lift that the panel describes, and the preset's values that it will use."""

from __future__ import annotations

from collections.abc import Collection

import bpy
from bpy.props import IntProperty

from ...engine.errors import PlgsError
from ...engine.job.prediction import USUAL_CLASSES, BakeCost, Prediction, machine_slowness, predict, predict_bake
from ...engine.job.request import usual_bake
from ...engine.posed import size_within
from ...engine.presets.options import with_options
from ...engine.presets.preset import PRESETS
from ..settings import PLGS_PG_settings, asked_of_preset, why_no_options
from .survey import survey_of_panel

_slowness = 1.0
"""This computer's time for a task, relative to the computer on which the predictions were measured."""


def learn_slowness() -> None:
    """Read from disk how long earlier lifts took on this computer."""
    global _slowness
    _slowness = machine_slowness()


def bake_estimate(frames: int, size: tuple[int, int], layers: Collection[str]) -> BakeCost:
    """Estimate the cost here of baking these frames at ``size`` (width, height) pixels with further ``layers``."""
    return predict_bake(frames, size, _slowness, layers)


def estimate_of(settings: PLGS_PG_settings) -> Prediction | None:
    """Estimate time and memory of the lift that the settings describe; None if unknown. Never reads the disk."""
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
        bake=usual_bake(preset) if settings.bake == "usual" else settings.bake,
        slowness=_slowness,
        classes=len(survey.classes) or USUAL_CLASSES,
    )


NAMES = ("steps", "width", "height", "frames")
"""The settings whose 0 means the preset's value: training steps, frame size in pixels, and number of frames."""


def used_options(settings: PLGS_PG_settings) -> dict[str, int]:
    """Return the values of NAMES that the lift will use, as far as known. Never reads the disk."""
    try:
        name, options = asked_of_preset(settings)
    except PlgsError:
        name, options = settings.preset, {}
    preset = with_options(PRESETS[name], options)
    survey = survey_of_panel(settings)
    if survey is None or survey.error is not None or not survey.sizes:
        return dict(zip(NAMES, (preset.steps, *preset.size, preset.frames), strict=True))
    (size, _), *_ = survey.sizes
    views = preset.views_of(survey.train_frames)
    used = preset.for_views(views).steps, *size_within(size, preset.size), views
    return dict(zip(NAMES, used, strict=True))


def _used(name: str, description: str, least: int = 0, **kinds: str) -> IntProperty:
    """Declare a property that shows the option ``name``'s value that will be used; typing into it sets the option."""

    def read(shown: PLGS_PG_used_options) -> int:
        return used_options(shown.id_data.plgs)[name]

    def write(shown: PLGS_PG_used_options, value: int) -> None:
        setattr(shown.id_data.plgs, name, value)

    explanation = f"{description}. 0: the preset's"
    return IntProperty(name=name.capitalize(), description=explanation, get=read, set=write, min=least, **kinds)


class PLGS_PG_used_options(bpy.types.PropertyGroup):
    """The actual values behind the zeros of `scene.plgs`: `scene.plgs_used`."""

    steps: _used("steps", "Training steps")
    width: _used("width", "Frames are scaled to fit this width", subtype="PIXEL")
    height: _used("height", "Frames are scaled to fit this height", subtype="PIXEL")
    frames: _used("frames", "Train on at most this many frames, the sharpest of each stretch; -1: on all", least=-1)


CLASSES = (PLGS_PG_used_options,)
PROPERTIES = ((bpy.types.Scene, "plgs_used", PLGS_PG_used_options),)
