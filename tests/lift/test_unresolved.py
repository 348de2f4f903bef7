"""The share of a picture that no photo resolves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from engine.job import EventWriter
from engine.lift.judging import Unresolved, tell_unresolved, unresolved
from engine.passes.layers import PanopticLayers
from engine.scene import Camera


def seen(camera: Camera, depth: float, alpha: float = 1.0) -> PanopticLayers:
    """A wall at a depth in metres. The right quarter of the picture shows nothing."""
    shape = camera.height, camera.width
    colour = np.full((*shape, 4), alpha, np.float32)
    colour[:, camera.width * 3 // 4 :, 3] = 0.0
    nothing = np.zeros(shape, np.int32)
    return PanopticLayers(colour, np.full(shape, depth, np.float32), nothing, nothing, colour[..., 0], colour[..., 0])


@pytest.mark.parametrize(
    ("forward", "coarse"),
    [(0.0, 0.0), (1.8, 0.0), (2.2, 0.75), (3.5, 0.75)],  # twice as near is at 2 m
)
def test_what_is_seen_from_nearer_than_the_photo(forward: float, coarse: float) -> None:
    photo, pose = Camera(640, 480, 600.0, 600.0, 320.0, 240.0, np.eye(4)), np.eye(4)
    pose[2, 3] = forward
    shot = photo.at(pose)
    found = unresolved(seen(shot, 4.0 - forward), shot, [photo])
    assert (found.coarse, found.empty) == pytest.approx((coarse, 0.25), abs=0.02)
    small = shot.resized(80, 60)
    assert unresolved(seen(small, 4.0 - forward), small, [photo], reduced=8.0).coarse == pytest.approx(coarse, abs=0.02)


def test_what_no_photo_shows_is_not_resolved_either() -> None:
    photo, pose = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4)), np.diag([-1.0, 1.0, -1.0, 1.0])
    assert unresolved(seen(photo.at(pose), 2.0), photo.at(pose), [photo]).coarse == pytest.approx(0.75, abs=0.02)


def test_a_large_share_is_a_warning(tmp_path: Path) -> None:
    events = EventWriter(tmp_path / "events.jsonl")
    tell_unresolved([], events, before=True)
    tell_unresolved([("a", Unresolved(0.0, 0.05))], events, before=True)
    tell_unresolved([("a", Unresolved(0.0, 0.02)), ("b", Unresolved(0.4, 0.18))], events, before=False)
    events.close()
    figures, warning = map(json.loads, (tmp_path / "events.jsonl").read_text().splitlines())
    assert figures["values"]["most"] == pytest.approx(0.58)
    assert "does not resolve 30% of the baked views (58% of b): 20% is shown" in warning["message"]
