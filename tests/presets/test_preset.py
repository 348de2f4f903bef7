"""The presets: what they are, and what options make of them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

import pytest

from engine.job import LiftRequest
from engine.job.request import PresetName
from engine.presets.options import changed_options, checked_options, option_value, preset_options, with_options
from engine.presets.preset import PRESETS, Preset
from engine.train.trainer import Trainer


def test_the_offered_ones_are_those_that_exist() -> None:
    assert get_args(PresetName) == tuple(PRESETS)
    for preset in PRESETS.values():
        json.dumps(asdict(preset))  # it goes into the manifest


@pytest.mark.parametrize("name", PRESETS)
def test_a_presets_own_values_change_nothing(name: str) -> None:
    values = {option: option_value(PRESETS[name], option) for option in preset_options()}
    assert checked_options(values) == values, "no preset has a value that is refused"
    assert with_options(PRESETS[name], values) == PRESETS[name] and changed_options(PRESETS[name], values) == {}


PAPERS_NUMBERS = {"steps": 30_000, "voxel_size": 0.02, "gaussians_per_anchor": 10, "instance_slots": 25}
PAPERS_WAYS = {
    "objects": "boxes",
    "linear_assignment": True,
    "one_class_an_object": False,
    "seeded_features": False,
    "warm_start": False,
    "steps_a_view": 0,
    "fill_holes": False,
    "fit_exposure": False,
    "weigh_sharpness": False,
    "labels": "decoders",
}


@pytest.mark.parametrize(("field", "value"), (PAPERS_NUMBERS | PAPERS_WAYS).items())
def test_the_preset_paper_follows_the_paper_to_the_letter(field: str, value: object) -> None:
    assert getattr(PRESETS["paper"], field) == value


def test_the_papers_schedule_and_losses() -> None:
    """Section "Implementation Details"; growth is Scaffold-GS's, which judges by shares of the steps."""
    paper, schedule, weights = PRESETS["paper"], Trainer.growth_schedule, PRESETS["paper"].weights
    assert paper.schedule.self_training_every * paper.steps == pytest.approx(5000)
    assert (schedule.grow_from * paper.steps, schedule.grow_until * paper.steps) == (1500, 15_000)
    assert (weights.ssim, weights.volume, weights.semantic, weights.instance) == (0.2, 0.001, 0.2, 0.2)
    assert weights.depth == 0 and paper.growth.least_visits is None
    assert paper.distance_input and paper.label_view_input and paper.neighbours > 0


def test_many_views_are_each_seen_often_enough() -> None:
    for preset in (PRESETS["preview"], PRESETS["standard"]):
        assert preset.for_views(3) == preset, "few views are seen often anyway"
        many = preset.for_views(2000)
        assert many.steps == 2000 * preset.steps_a_view > preset.steps
        assert many.growth.least_visits is not None
        # In the half of the lift in which anchors grow, a view comes up more than twice.
        assert many.steps * Trainer.growth_schedule.grow_until > 2 * 2000
    assert PRESETS["paper"].for_views(2000) == PRESETS["paper"]


def test_options_of_a_request() -> None:
    options = {"steps": 7, "size": [100, 50], "weights.depth": 0, "warm_start": False, "growth.least_visits": None}
    chosen = LiftRequest(scene=Path("/room"), preset="standard", options=options).chosen_preset
    assert (chosen.steps, chosen.size, chosen.weights.depth, chosen.warm_start) == (7, (100, 50), 0.0, False)
    assert chosen.growth.least_visits is None and chosen.weights.ssim == PRESETS["standard"].weights.ssim
    assert chosen.for_views(1000).steps == 7, "steps are exactly that many"
    both = LiftRequest(Path("/scene"), options={"steps": 600, "steps_a_view": 5}).chosen_preset
    assert both.for_views(200).steps == 1000


@dataclass(frozen=True)
class _Further(Preset):
    colour: bool = False


def test_further_options_can_be_added(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, preset in list(PRESETS.items()):
        monkeypatch.setitem(PRESETS, name, _Further(**vars(preset)))
    assert option_value(with_options(PRESETS["paper"], checked_options({"colour": True})), "colour") is True
    assert (PRESETS["paper"].steps, list(preset_options())[-1]) == (30_000, "colour")
