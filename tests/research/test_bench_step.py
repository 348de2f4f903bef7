"""The benchmark of a training step: what it measures adds up, and it leaves nothing behind."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace

import pytest

from research.bench_step import StepProfile, profile_lift, typical
from tests.train.tiny_lift import TINY, views_of

WITHOUT_GROWTH = replace(TINY, steps=1000)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> StepProfile:
    views, classes = views_of(tmp_path_factory.mktemp("step") / "scene")
    folder = tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder))
        measured = profile_lift(views, classes, WITHOUT_GROWTH, steps=6)
    assert not list(folder.glob("tmp*"))  # torch keeps a folder of its own there
    return measured


def test_every_part_of_a_step_is_measured(profile: StepProfile) -> None:
    assert set(profile.parts) == {
        "decode, forward", "decode, backward", "rasterise, forward", "rasterise, backward", "SSIM, L1, volume",
        "label losses", "further losses", "losses, backward", "growth statistics", "optimiser", "the rest",
    }  # fmt: skip
    assert all(milliseconds > 0 for milliseconds in profile.parts.values())
    assert profile.cores > 0
    assert profile.draw > 0 and profile.decide > 0 and 0 < profile.visible <= profile.anchors and profile.gaussians > 0
    facts = json.loads(json.dumps(profile.facts()))
    assert facts["step_ms"] == pytest.approx(sum(facts["parts_ms"].values()))


def test_a_disturbed_step_is_left_out_and_parts_add_up() -> None:
    steps = [{"one": 1.0 + k, "two": 2.0} for k in range(7)] + [{"one": 500.0, "two": 2.0}]
    parts = typical(steps)
    assert parts == pytest.approx({"one": 4500.0, "two": 2000.0})
    with pytest.raises(ValueError, match="no step"):
        typical([])
