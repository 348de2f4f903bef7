"""What the lift that the panel is set to will take."""

from __future__ import annotations

from collections.abc import Collection

from ...engine.job.prediction import USUAL_CLASSES, BakeCost, Prediction, machine_slowness, predict, predict_bake
from ...engine.presets.options import with_options
from ...engine.presets.preset import PRESETS
from ..settings import PLGS_PG_settings, asked_of_preset, chosen_scene, why_no_options
from .survey import survey_of

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
    survey = survey_of(chosen_scene(settings)) if settings.scene_folder else None
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
