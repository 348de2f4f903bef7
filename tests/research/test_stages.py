"""Where the paper's method loses panoptic quality."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from engine.job import LiftRequest
from engine.presets.preset import PRESETS
from research.experiments.experiment import SceneToLift
from research.stages import stages_table
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as

PRESET = replace(PRESETS["paper"], voxel_size=0.1)


def test_stages_are_scored_on_predicted_and_true_masks(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "room", frames=8, size=(64, 48), noise=0.4)
    with presets_as(preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene, bake="all"))
    rows = {}
    for line in [*stages_table(SceneToLift("room", scene, "z"), PRESET, lift.path)][2:]:
        name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        rows[name] = [tuple(map(float, re.findall(r"[\d.]+", cell))) for cell in cells]
    own, by_boxes, true_numbers, learnt, _, _, trained = rows.values()
    assert true_numbers[1] == (100, 100) and own[1][0] == 100 and own[0][0] < 95
    assert own[1][1] < by_boxes[1][1] > 95, "Algorithm 1 numbers true masks"
    assert learnt[0][0] > 50 and learnt[1][0] > 90
    assert 0 < trained[0][0] <= 100 and trained[1] == ()


def test_a_scene_without_truth_is_refused(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "room", frames=4, ground_truth=False)
    with raises_key("no-truth"):
        list(stages_table(SceneToLift("room", scene, "z"), PRESET, None))
