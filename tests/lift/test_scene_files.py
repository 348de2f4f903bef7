"""What of a lifted scene is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engine.lift.scene_files import shown_by_depth
from engine.scene import load_view, open_scene
from tests.tiny_scene import write_tiny_scene


def test_places_that_no_depth_shows_are_noise(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path, frames=2, size=(80, 60)))
    views = [load_view(frame) for frame in scene.frames]
    on_it = [view.camera.unproject(view.depth)[view.depth > 0][::50] for view in views]
    beyond = [view.camera.unproject(view.depth + 0.4)[view.depth > 0][::50] for view in views[:1]]
    places = np.concatenate([*on_it, *beyond])
    is_shown = shown_by_depth(places, views)
    assert is_shown[: -len(beyond[0])].all() and not is_shown[-len(beyond[0]) :].any()
    assert not shown_by_depth(places, []).any()
