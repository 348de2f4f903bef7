"""Lifts of scenes with as little, or as odd, as a scene may have."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.job import LiftFolder, LiftRequest, verify
from engine.lift.scene_files import read_model
from tests.tiny_scene import CABINET_ID, CATEGORIES, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as, short_warm_start

FRAMES, HIGHEST = 5, 65535


def as_they_are(scene: Path) -> None:
    pass


def equal_poses(scene: Path) -> None:
    for path in (scene / "pose").iterdir():
        shutil.copy(scene / "pose" / "0000.txt", scene / "copy.txt")
        (scene / "copy.txt").replace(path)


def one_class_with_high_ids(scene: Path) -> None:
    """One thing fills every picture, in two halves with the highest ids of 16 bits."""
    table = json.loads((scene / "panoptic.json").read_text())
    table["categories"] = [each for each in CATEGORIES if each["id"] == CHAIR_ID]
    for each in table["annotations"]:
        each["segments_info"] = [{"id": HIGHEST - half, "category_id": CHAIR_ID} for half in range(2)]
        path = scene / "panoptic" / each["file_name"]
        shown = np.zeros_like(cv2.imread(str(path)))
        shown[..., 1:] = 255  # blue, green, red: id = R + 256 G + 65536 B
        shown[:, ::2, 2] = 254
        cv2.imwrite(str(path), shown)
    (scene / "panoptic.json").write_text(json.dumps(table))
    shutil.rmtree(scene / "gt")


@pytest.mark.parametrize(
    ("frames", "change"), [(1, as_they_are), (2, as_they_are), (FRAMES, equal_poses), (FRAMES, one_class_with_high_ids)]
)
def test_scenes_of_unusual_size_are_lifted(frames: int, change: Callable[[Path], None], tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=frames, size=(32, 24))
    change(scene)
    with presets_as(preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene=scene, options={"steps": 2}))
    assert verify(lift.result_path).files


STEPS = 12


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> LiftFolder:
    folder = tmp_path_factory.mktemp("paper")
    scene = write_tiny_scene(folder / "scene", frames=8)
    request = LiftRequest(scene=scene, preset="paper", options={"steps": STEPS}, bake="test")
    with short_warm_start():
        return lift_into(folder / "lift", request)


def test_the_papers_algorithm_1_finds_the_objects_of_the_room(lift: LiftFolder) -> None:
    found = json.loads((lift.result_path / "instances.json").read_text())["instances"]
    assert sorted(one["class_id"] for one in found) == [CABINET_ID, CHAIR_ID]
    # Matched by boxes: every mask but an instance's first has a cost, and no view was asked for its agreement.
    assert all(segment["agreement"] is None for one in found for segment in one["segments"])
    assert all(sum(segment["cost"] is None for segment in one["segments"]) == 1 for one in found)


def test_the_preset_paper_builds_the_papers_model(lift: LiftFolder) -> None:
    scene = read_model(lift)
    assert scene.anchors.gaussians_per_anchor == 10 and scene.voxel_size == 0.02
    assert scene.decoders.shape.label_view_input and scene.decoders.shape.distance_input
    assert len(scene.channels.instance_slots) == 2 and len(scene.channels.slot_ids) == 26  # 25 and "no object"
    assert scene.voted is None


def test_a_lift_of_preset_paper_is_baked_and_scored(lift: LiftFolder) -> None:
    assert [path.suffix for path in lift.passes_path.iterdir()] == [".exr"]
    tables = json.loads((lift.result_path / "metrics.json").read_text())["tables"]
    assert {"lifted"} <= {table["name"] for table in tables}
