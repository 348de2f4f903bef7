"""Passes tell one story, and what no mask named is nobody's: the twin without the masks of one chair."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.job import LiftFolder, LiftRequest
from engine.passes.exr import read_exr
from tests.passes.agreement import pairs_of
from tests.train.tiny_lift import lift_into

ROOT = Path(__file__).resolve().parents[2]
CHAIR = 3
"""A dining chair among others, in the ground truth."""


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> LiftFolder:
    """All frames of a short lift, baked."""
    folder = tmp_path_factory.mktemp("agreeing")
    scene = folder / "scene"
    made = [sys.executable, "sample/hand_held.py", "sample/room", str(scene), "--seed", "0"]
    subprocess.run(made, cwd=ROOT, check=True, capture_output=True, timeout=900)
    for mask in sorted((scene / "panoptic").glob("*.png")):
        pixels, truth = (cv2.imread(str(path), -1) for path in (mask, scene / "gt/instance" / mask.name))
        pixels[cv2.dilate((truth == CHAIR).astype(np.uint8), np.ones((5, 5))) > 0] = 0
        cv2.imwrite(str(mask), pixels)
    request = LiftRequest(scene=scene, options={"steps": 200, "size": [160, 120]}, bake="all")
    return lift_into(folder / "lift", request)


@pytest.mark.slow
def test_ids_and_mattes_agree(lift: LiftFolder) -> None:
    ious = np.array([pair.iou for pair in pairs_of(lift.path)])
    assert len(ious) > 300
    assert ious.min() >= 0.5 and (ious >= 0.8).mean() >= 0.95


@pytest.mark.slow
def test_what_no_mask_named_is_unassigned_and_uncertain(lift: LiftFolder) -> None:
    owned, confidence, usual = [], [], []
    for truth in sorted((ROOT / "sample/room/gt/instance").glob("*.png")):
        layers, ids = read_exr(lift.passes_path / f"{truth.stem}.exr"), cv2.imread(str(truth), -1)
        inside = cv2.erode((ids == CHAIR).astype(np.uint8), np.ones((5, 5))) > 0
        owned.append(layers.instance[inside] > 0)
        confidence.append(layers.confidence[inside])
        usual.append(layers.confidence[(ids > 0) & (ids != CHAIR)])
    assert np.concatenate(owned).mean() < 0.25
    assert np.concatenate(confidence).mean() < np.concatenate(usual).mean() - 0.2
