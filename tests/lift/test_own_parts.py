"""Matchers, losses and heads that a script adds."""

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
from engine.presets import parts
from engine.presets.options import checked_options, parsed_options
from engine.presets.preset import Preset
from engine.train.trainer import LOSSES, Step, register_loss
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as, warnings_in


def transparent(step: Step) -> torch.Tensor:
    return 5.0 * step.rendering.alpha.mean()


@pytest.fixture(autouse=True)
def own_parts() -> Iterator[None]:
    register_matcher("mine", no_objects)
    register_loss("transparent", transparent)
    yield
    for known, name in ((MATCHERS, "mine"), (LOSSES, "transparent")):
        del known[name]
    parts._ADDED.clear()


def lifted(folder: Path, **options: object) -> LiftFolder:
    scene = folder / "scene" if (folder / "scene").exists() else write_tiny_scene(folder / "scene", 4, (32, 24))
    with presets_as(preview=TINY):
        return lift_into(folder / f"lift{len(options)}", LiftRequest(scene, options={"steps": 6, **options}))


@pytest.mark.parametrize("keeps", [True, False])
def test_a_users_matcher_that_returns_label_maps_keeps_the_votes(tmp_path: Path, keeps: bool) -> None:
    def matcher(given: ViewsToMatch, preset: Preset, progress: StageProgress) -> Matching:
        found = objects_by_agreement(given, preset, progress)
        return found if keeps else replace(found, label_maps=None)

    MATCHERS["mine"] = matcher
    own = lifted(tmp_path, objects="mine")
    with safe_open(own.result_path / "model.safetensors", "pt") as file:
        assert ("voted.label" in file.keys()) == keeps  # noqa: SIM118 - it is no mapping
    assert (NO_VOTES in warnings_in(own.events_path)) != keeps


def test_unregistered_matchers_and_losses_can_be_read_but_not_used(tmp_path: Path) -> None:
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


def test_the_training_log_of_a_resumed_lift_lists_each_step_once(tmp_path: Path) -> None:
    for done, step in ((0, 1), (1, 2), (2, 3), (2, 3)):  # the third was lost, and is done again
        log = TrainingLog(tmp_path / "training.csv", done)
        log.add({"step": step, "loss": 0.5 + done})
        log.close()
    assert (tmp_path / "training.csv").read_text() == "step,loss\n1,0.5\n2,1.5\n3,2.5\n"


def test_relative_scene_paths_start_at_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert LiftRequest(Path("room"), masks=Path("../masks")).scene == tmp_path / "room"
