"""Boxes are read back by the readers of CVAT (Datumaro's) and of labelCloud, from the package index."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from engine.export.source import FinishedLift
from engine.job import LiftFolder
from tests.export.conftest import run

ROUNDED = 0.00501
"""Datumaro keeps two digits of each number."""
READERS = ("datumaro==1.13.12", "labelcloud==1.1.1")


@pytest.mark.slow
def test_cvats_and_labelclouds_readers_find_the_objects(lift: LiftFolder, tmp_path: Path) -> None:
    packages, boxes = tmp_path / "packages", tmp_path / "boxes"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(packages), *READERS]
    subprocess.run(install, check=True, timeout=900)
    run(lift, "boxes", boxes)
    script = Path(__file__).with_name("labelling_programs.py")
    command = [sys.executable, str(script), str(packages), str(boxes)]
    said = subprocess.run(command, check=True, timeout=300, capture_output=True, text=True, cwd=tmp_path).stdout
    found = json.loads(said.rpartition("FOUND")[2])
    listed = FinishedLift(lift, ["all"]).listed
    assert Path(found["points"]) == boxes / "cvat/ds0/pointcloud/points.pcd"
    assert len(found["cuboids"]) == len(found["boxes"]) == len(listed) > 0
    for one, cuboid, box in zip(listed, found["cuboids"], found["boxes"], strict=True):
        assert (cuboid["name"], cuboid["class"], cuboid["id"]) == (one.name, one.class_name, one.id)
        assert box["class"] == one.class_name
        for each, within in ((cuboid, ROUNDED), (box, 1e-6)):
            assert np.allclose(each["centre"], one.centre, 0, within) and np.allclose(each["size"], one.size, 0, within)
        assert np.allclose(cuboid["rotation"], (0, 0, one.yaw), 0, ROUNDED)
        turn = np.array([[np.cos(one.yaw), -np.sin(one.yaw), 0], [np.sin(one.yaw), np.cos(one.yaw), 0], [0, 0, 1]])
        inside = (np.array(box["corners"]) - one.centre) @ turn  # as labelCloud draws it
        assert np.allclose(np.abs(inside), np.array(one.size) / 2, atol=1e-6)
