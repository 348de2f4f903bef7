"""Matchers, losses and heads that a script adds."""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from engine.job import LiftFolder, LiftRequest
from engine.job.progress import StageProgress
from engine.job.training_log import TrainingLog
from engine.lift.objects import (
    MATCHERS,
    Matching,
    ViewsToMatch,
    no_objects,
    objects_by_agreement,
    register_matcher,
)
from engine.lift.run import NO_VOTES
from engine.model.decoders import DECODERS, Decoders, register_head
from engine.presets import parts
from engine.presets.options import checked_options, parsed_options
from engine.presets.preset import Preset
from engine.train.trainer import LOSSES, Step, register_loss
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as, warnings_in


class OneLabel(Decoders):
    """All Gaussians show the first class."""

    kind = "one_label"

    def label_logits(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        classes, slots = super().label_logits(feature, seen)
        return classes * 0 + 99.0 * (torch.arange(classes.shape[2]) == 0), slots


def transparent(step: Step) -> torch.Tensor:
    return 5.0 * step.rendering.alpha.mean()


@pytest.fixture(autouse=True)
def own_parts() -> Iterator[None]:
    register_matcher("mine", no_objects)
    register_loss("transparent", transparent)
    register_head(OneLabel)
    yield
    for known, name in ((MATCHERS, "mine"), (LOSSES, "transparent"), (DECODERS, "one_label")):
        del known[name]
    parts._ADDED.clear()


def lifted(folder: Path, **options: object) -> LiftFolder:
    scene = folder / "scene" if (folder / "scene").exists() else write_tiny_scene(folder / "scene", 4, (32, 24))
    with presets_as(preview=TINY):
        return lift_into(folder / f"lift{len(options)}", LiftRequest(scene, options={"steps": 6, **options}))


def steps_of(lift: LiftFolder) -> list[dict[str, str]]:
    return list(csv.DictReader(lift.training_path.open()))


def test_registered_parts_are_used_and_recorded(tmp_path: Path) -> None:
    plain = lifted(tmp_path)
    own = lifted(tmp_path, losses=["depth", "transparent"], head="one_label", labels="decoders")
    steps, before = steps_of(own), steps_of(plain)
    assert [int(row["step"]) for row in steps] == [1, 2, 3, 4, 5, 6]
    assert float(before[0]["depth"]) > 0 and "transparent" not in before[0]
    assert float(steps[0]["loss"]) > float(before[0]["loss"]) + 0.5 * float(steps[0]["transparent"]) > 1.0
    versions, old = (json.loads((each.manifest_path).read_text())["versions"] for each in (own, plain))
    assert {"loss transparent", "head one_label"} <= {*versions} and versions["code"] != old["code"]


@pytest.mark.parametrize("keeps", [True, False])
def test_a_matcher_that_returns_label_maps_keeps_the_votes(tmp_path: Path, keeps: bool) -> None:
    def matcher(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
        found = objects_by_agreement(given, preset, progress)
        return found if keeps else replace(found, label_maps=None)

    MATCHERS["mine"] = matcher
    own = lifted(tmp_path, objects="mine")
    with safe_open(own.result_path / "model.safetensors", "pt") as file:
        assert ("voted.label" in file.keys()) == keeps  # noqa: SIM118 - it is no mapping
    assert (NO_VOTES in warnings_in(own.events_path)) != keeps


def test_names_of_other_programs_are_read_and_not_lifted(tmp_path: Path) -> None:
    assert checked_options({"objects": "somebodys", "losses": ["theirs"]})["objects"] == "somebodys"
    assert parsed_options(["objects=mine", "losses=depth, transparent"])["losses"] == ["depth", "transparent"]
    assert parsed_options(["losses=none"])["losses"] == []
    for text in ("objects=somebodys", "losses=theirs", "head=other"):
        with raises_key("bad-value"):
            parsed_options([text])
    with raises_key("no-part agreement"):
        lifted(tmp_path, objects="agrement")
    for name in ("boxes", "no name", ""):
        with pytest.raises(ValueError, match="not a valid name for an added matcher"):
            register_matcher(name, no_objects)


def test_a_resumed_lift_goes_on_with_the_losses_of_its_checkpoint(tmp_path: Path) -> None:
    for done, step in ((0, 1), (1, 2), (2, 3), (2, 3)):  # the third was lost, and is done again
        log = TrainingLog(tmp_path / "training.csv", done)
        log.add({"step": step, "loss": 0.5 + done})
        log.close()
    assert (tmp_path / "training.csv").read_text() == "step,loss\n1,0.5\n2,1.5\n3,2.5\n"


def test_a_relative_scene_is_found_from_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert LiftRequest(Path("room"), masks=Path("../masks")).scene == tmp_path / "room"
