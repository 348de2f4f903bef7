"""The paper's letter runs from end to end: every stage of the preset `paper`, a few steps of it."""

from __future__ import annotations

import json

import pytest

from engine.job import LiftFolder, LiftRequest
from engine.lift.scene_files import read_model
from tests.tiny_scene import CABINET_ID, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import lift_into, short_warm_start

STEPS = 12


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> LiftFolder:
    folder = tmp_path_factory.mktemp("paper")
    scene = write_tiny_scene(folder / "scene", frames=8)
    request = LiftRequest(scene=scene, preset="paper", options={"steps": STEPS}, bake="test")
    with short_warm_start():
        return lift_into(folder / "lift", request)


def test_algorithm_1_finds_the_rooms_objects(lift: LiftFolder) -> None:
    found = json.loads((lift.result_path / "instances.json").read_text())["instances"]
    assert sorted(one["class_id"] for one in found) == [CABINET_ID, CHAIR_ID]
    # Matched by boxes: every mask but an instance's first has a cost, and no view was asked for its agreement.
    assert all(segment["agreement"] is None for one in found for segment in one["segments"])
    assert all(sum(segment["cost"] is None for segment in one["segments"]) == 1 for one in found)


def test_the_model_is_the_papers(lift: LiftFolder) -> None:
    scene = read_model(lift)
    assert scene.anchors.gaussians_per_anchor == 10 and scene.voxel_size == 0.02
    assert scene.decoders.shape.label_view_input and scene.decoders.shape.distance_input
    assert len(scene.channels.instance_slots) == 2 and len(scene.channels.slot_ids) == 26  # 25 and "no object"
    assert scene.voted is None


def test_it_is_baked_and_scored(lift: LiftFolder) -> None:
    assert [path.suffix for path in lift.passes_path.iterdir()] == [".exr"]
    tables = json.loads((lift.result_path / "metrics.json").read_text())["tables"]
    assert {"lifted"} <= {table["name"] for table in tables}
