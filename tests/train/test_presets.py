"""The presets, and what a user may change of them."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from engine.job.request import PRESETS as OFFERED
from engine.train.presets import PRESETS, Preset, chosen_preset


def test_those_offered_are_those_there_are() -> None:
    assert set(OFFERED) == set(PRESETS)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=list(PRESETS))
def test_schedules_lie_within_the_lift(preset: Preset) -> None:
    schedule = preset.schedule
    assert 0 <= schedule.statistics_from < schedule.grow_from < schedule.grow_until <= 1
    assert 0 < schedule.self_training_every < 1
    assert preset.neighbours >= 0 and 0 < preset.agreement <= 1 and -1 < preset.tau_new < 0
    json.dumps(asdict(preset))  # it goes into the manifest


def test_the_papers_numbers() -> None:
    paper = PRESETS["paper"]
    assert (paper.steps, paper.voxel_size, paper.gaussians_per_anchor, paper.instance_slots) == (30_000, 0.02, 10, 25)
    assert paper.schedule.self_training_every * paper.steps == 5000
    assert (paper.schedule.grow_from * paper.steps, paper.schedule.grow_until * paper.steps) == (1500, 15_000)
    assert (paper.weights.ssim, paper.weights.volume) == (0.2, 0.001)
    assert (paper.objects, paper.warm_start, paper.seeded_features, paper.agreement) == ("boxes", None, False, 1.0)


def test_what_a_user_chooses() -> None:
    assert chosen_preset("preview") is PRESETS["preview"]
    chosen = chosen_preset("standard", steps=7, size=(100, 50))
    assert (chosen.steps, chosen.size_within) == (7, (100, 50))
    assert chosen.voxel_size == PRESETS["standard"].voxel_size
    with pytest.raises(KeyError):
        chosen_preset("hasty")
