"""How much a view's word counts."""

from __future__ import annotations

import numpy as np
import pytest

from engine.presets.preset import EvidenceKind
from engine.scene import evidence, load_view, open_scene, resolution_of
from tests.tiny_scene import write_tiny_scene


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("views", [1, 1]), ("root", [3, 4]), ("resolution", [2, 0.5]), ("pixels", [9, 16]), ("density", [4, 0.25])],
)
def test_votes_of_each_kind(kind: EvidenceKind, expected: list[float]) -> None:
    np.testing.assert_allclose(evidence(kind, np.array([9.0, 16.0]), np.array([2.0, 0.5])), expected)


def test_the_resolution_is_that_of_the_masks_whatever_size_they_are_read_at(tmp_path) -> None:
    frame = open_scene(write_tiny_scene(tmp_path / "scene", frames=2)).train_frames[0]
    whole, half = load_view(frame), load_view(frame, (frame.size[0] // 2, frame.size[1] // 2))
    assert (whole.mask_scale, half.mask_scale) == (1.0, 2.0)
    expected = 0.01 * np.sqrt(frame.camera.fx * frame.camera.fy) / whole.depth
    np.testing.assert_allclose(resolution_of(whole)[whole.depth > 0], expected[whole.depth > 0], rtol=1e-5)
    assert not resolution_of(whole)[whole.depth <= 0].any()
    known = half.depth > 0
    np.testing.assert_allclose(resolution_of(half)[known], 0.01 * frame.camera.fx / half.depth[known], rtol=0.05)
