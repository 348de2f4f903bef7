"""What a view's word counts, measured on the labelled cloud."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest

from engine.presets.preset import PRESETS, SegmentVoting, ViewEvidence
from research import labelled_cloud
from research.experiments.experiment import SceneToLift
from tests.tiny_scene import write_tiny_scene

PRESET = replace(PRESETS["preview"], voxel_size=0.2)


def test_each_kind_is_in_each_place_once() -> None:
    ways = dict(labelled_cloud.ways(PRESET))
    assert ways["as shipped"] == PRESET
    evidence = {name: way.evidence for name, way in ways.items()}
    assert evidence["all: views"] == replace(ViewEvidence(), objects="views", segments="views", masks="views")
    assert evidence["masks: pixels"] == replace(ViewEvidence(), masks="pixels")
    assert ways["neither"] == replace(PRESET, segment_voting=SegmentVoting(neighbours=False, near=False))
    assert len(ways) == 1 + 3 + 5 + 3 * 4


def test_one_row_per_way_and_one_column_per_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    every = labelled_cloud.ways
    monkeypatch.setattr(labelled_cloud, "ways", lambda shipped: islice(every(shipped), 2))
    scene = write_tiny_scene(tmp_path / "room", frames=10)
    head, _, shipped, alone = labelled_cloud.evidence_table([SceneToLift("room", scene, "z")], PRESET)
    assert head == "| | room | mean |"
    for line, name in ((shipped, "as shipped"), (alone, "points vote alone")):
        found, room, mean = (cell.strip() for cell in line.strip("|").split("|"))
        assert found == name and room == mean
        miou, pq = (float(figure) for figure in room.split(",")[0].split("/"))
        assert 60 < miou <= 100 and 40 < pq <= 100  # exact masks and depth


def test_masks_that_are_held_back_judge_the_scene_they_are_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    every = labelled_cloud.ways
    monkeypatch.setattr(labelled_cloud, "ways", lambda shipped: islice(every(shipped), 1))
    place = SceneToLift("room", write_tiny_scene(tmp_path / "scenes" / "room", frames=10), "z")
    assert labelled_cloud.masks_of(place, str(tmp_path / "scenes/{scene}")) == place.folder
    (found,) = labelled_cloud.scene_scores(place, PRESET, hold_back=True)
    assert 0.6 < found.masks <= 1.0 and "masks" in str(found)  # exact masks and depth
