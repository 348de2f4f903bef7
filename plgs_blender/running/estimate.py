"""What the lift that the panel is set to will take: from what the survey saw, and how fast this machine has been."""

from __future__ import annotations

from ...engine.job.effort import chosen_effort
from ...engine.job.prediction import USUAL_CLASSES, Prediction, predict
from ..scene_survey import survey_of
from ..settings import PLGS_PG_settings, asked_of_preset, place_of, why_no_options
from . import machine_pace


def estimate_of(settings: PLGS_PG_settings) -> Prediction | None:
    """Time and memory of the lift that the settings ask for, None while the scene is not known, or something is
    wrong.

    Looks at no disk: panels call it.
    """
    survey = survey_of(place_of(settings)) if settings.scene_folder else None
    if survey is None or survey.error is not None or not survey.sizes:
        return None
    if why_no_options(settings):
        return None
    asked = asked_of_preset(settings)
    steps, size, frames = (asked.get(name) for name in ("steps", "size", "frames"))
    effort = chosen_effort(asked["preset"], steps, size, frames, asked["options"])
    (size, _), *_ = survey.sizes
    return predict(
        survey.train_frames,
        survey.test_frames,
        size,
        effort,
        bake=settings.bake,
        slowness=machine_pace.slowness(),
        classes=len(survey.classes) or USUAL_CLASSES,
    )
