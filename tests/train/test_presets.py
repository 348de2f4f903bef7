"""The presets, and what a user may change of them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from engine.job import LiftRequest
from engine.job.effort import EFFORTS, chosen_effort
from engine.job.request import PRESETS as OFFERED
from engine.train.option_table import requested_preset
from engine.train.presets import PRESETS, Preset, chosen_preset


def test_those_offered_are_those_there_are() -> None:
    assert set(OFFERED) == set(PRESETS)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=list(PRESETS))
def test_schedules_lie_within_the_lift(preset: Preset) -> None:
    schedule = preset.schedule
    assert 0 <= schedule.statistics_from < schedule.grow_from < schedule.grow_until <= 1
    assert 0 < schedule.self_training_every <= 1  # 1: no rounds, since votes have relabelled the segments before
    assert preset.neighbours >= 0 and 0 < preset.agreement <= 1 and -1 < preset.matching.tau_new < 0
    assert preset.vote_rounds >= 1 and preset.instance_slots >= 0
    json.dumps(asdict(preset))  # it goes into the manifest


PAPERS_NUMBERS = {
    "steps": 30_000,
    "voxel_size": 0.02,
    "gaussians_per_anchor": 10,
    "features": 32,
    "instance_slots": 25,
    "agreement": 1.0,
}
PAPERS_WAYS = {
    "objects": "boxes",
    "linear_assignment": True,
    "one_class_an_object": False,
    "seeded_features": False,
    "warm_start": None,
    "steps_a_view": 0,
    "fill_holes": False,
    "fit_exposure": False,
    "weigh_sharpness": False,
    "labels": "decoders",
}


@pytest.mark.parametrize(("field", "value"), (PAPERS_NUMBERS | PAPERS_WAYS).items())
def test_the_preset_paper_keeps_to_the_letter(field: str, value: object) -> None:
    assert getattr(PRESETS["paper"], field) == value


def test_the_papers_schedule_and_losses() -> None:
    """Section "Implementation Details"; growth is Scaffold-GS's, which judges by shares of the steps."""
    paper, schedule, weights = PRESETS["paper"], PRESETS["paper"].schedule, PRESETS["paper"].weights
    assert schedule.self_training_every * paper.steps == pytest.approx(5000)
    assert (schedule.grow_from * paper.steps, schedule.grow_until * paper.steps) == (1500, 15_000)
    assert (weights.ssim, weights.volume, weights.semantic, weights.instance) == (0.2, 0.001, 0.2, 0.2)
    assert weights.depth == 0 and paper.growth.least_visits is None
    assert paper.distance_input and paper.label_view_input and paper.neighbours > 0


@pytest.mark.parametrize("name", PRESETS)
def test_lifts_take_the_steps_that_were_predicted(name: str) -> None:
    for views in (1, 100, 101, 2000):
        assert PRESETS[name].for_views(views).steps == EFFORTS[name].steps_for(views)
        chosen = chosen_preset(name, steps=7), chosen_effort(name, steps=7)
        assert chosen[0].for_views(views).steps == chosen[1].steps_for(views) == 7


def test_many_views_are_each_seen_often_enough() -> None:
    for preset in (PRESETS["preview"], PRESETS["standard"]):
        assert preset.for_views(3) == preset, "few views are seen often anyway"
        many = preset.for_views(2000)
        assert many.steps == 2000 * preset.steps_a_view > preset.steps
        assert many.growth.least_visits is not None
        # In the half of the lift in which anchors grow, a view comes up more than twice.
        assert many.steps * many.schedule.grow_until > 2 * 2000
    assert PRESETS["paper"].for_views(2000) == PRESETS["paper"]


def test_what_a_user_chooses() -> None:
    assert chosen_preset("preview") is PRESETS["preview"]
    chosen = chosen_preset("standard", steps=7, size=(100, 50))
    assert (chosen.steps, chosen.size_within) == (7, (100, 50))
    assert chosen.voxel_size == PRESETS["standard"].voxel_size
    with pytest.raises(KeyError):
        chosen_preset("hasty")


def test_options_that_cost_time_are_predicted() -> None:
    options = {"voxel_size": 0.1, "gaussians_per_anchor": 2, "schedule.self_training_every": 0.5, "objects": "boxes"}
    effort = chosen_effort("preview", options=options)
    assert (effort.voxel_size, effort.gaussians_per_anchor, effort.self_training_every) == (0.1, 2, 0.5)
    assert effort.steps == EFFORTS["preview"].steps


def test_options_of_groups_are_not_taken_for_the_presets_own() -> None:
    assert chosen_effort("preview", options={"warm_start.steps": 7}) == EFFORTS["preview"]
    both = chosen_effort("preview", steps=600, options={"steps_a_view": 5.0})
    request = LiftRequest(Path("/scene"), steps=600, options={"steps_a_view": 5.0})
    assert both.steps_for(200) == requested_preset(request).for_views(200).steps == 1000
