"""Every choice of a preset by name: the table that Blender reads is that of the dataclasses."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.job import LiftRequest
from engine.job.preset_options import TABLE, checked_value, preset_options
from engine.train.option_table import requested_preset, table_text, with_options
from engine.train.presets import PRESETS, WarmStart


def test_the_table_is_that_of_the_presets() -> None:
    assert TABLE.read_text() == table_text(), "python -m engine presets --json > engine/job/preset_options.json"


@pytest.mark.parametrize("name", PRESETS)
def test_a_presets_own_values_change_nothing(name: str) -> None:
    options = {one.name: one.values[name] for one in preset_options().values()}
    for one in preset_options().values():
        if one.values[name] is not None:
            assert checked_value(one, one.values[name]) == one.values[name], "no preset has a value that is refused"
    kept = {key: value for key, value in options.items() if value is not None or preset_options()[key].can_be_none}
    if options["warm_start"] is None:
        kept = {key: value for key, value in kept.items() if not key.startswith("warm_start.")}
    assert with_options(PRESETS[name], kept) == PRESETS[name]


def test_options_of_a_request() -> None:
    options = {"weights.depth": 0, "consensus.rules.visible": 0.5, "rates.feature": [1, 0.1], "warm_start": None}
    chosen = requested_preset(LiftRequest(scene=Path("/room"), steps=7, options=options))
    assert (chosen.steps, chosen.weights.depth, chosen.consensus.rules.visible) == (7, 0.0, 0.5)
    assert chosen.rates.feature == (1.0, 0.1) and chosen.warm_start is None
    assert chosen.weights.ssim == PRESETS["preview"].weights.ssim


def test_an_option_of_a_group_that_was_left_out() -> None:
    request = LiftRequest(scene=Path("/room"), preset="paper", options={"warm_start.steps": 9})
    assert requested_preset(request).warm_start == WarmStart(steps=9)
    request = LiftRequest(scene=Path("/room"), preset="paper", options={"warm_start": "default"})
    assert requested_preset(request).warm_start == WarmStart()
