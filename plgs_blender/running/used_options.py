"""What a lift will use where the settings leave it to the preset, as the panel shows and edits it."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
from bpy.props import IntProperty, PointerProperty

from ...engine.errors import PlgsError
from ...engine.posed import size_within
from ...engine.presets.options import with_options
from ...engine.presets.preset import PRESETS
from ..settings import PLGS_PG_settings, asked_of_preset, chosen_scene
from .survey import survey_of

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
    survey = survey_of(chosen_scene(settings)) if settings.scene_folder else None
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
