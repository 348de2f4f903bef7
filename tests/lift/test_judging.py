"""The masks as judges of a finished lift."""

import json
import logging
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from engine.job import EventReader, EventWriter
from engine.job.report import doubt_of_frames
from engine.lift.judging import Judgement, Unresolved, judge, read_held_back, report_unresolved, unresolved
from engine.passes.layers import PanopticLayers
from engine.scene import Camera, load_view, open_scene
from tests.tiny_scene import CHAIR_ID, WALL_ID, trace_view, write_tiny_scene

SIZE = (64, 48)


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("judging") / "scene", frames=8, size=SIZE)


def seen_by(camera: Camera) -> SimpleNamespace:
    """The true classes that a camera sees, with half of the votes."""
    classes = trace_view(camera.camera_to_world, camera.K, camera.size).semantic
    return SimpleNamespace(semantic=classes, confidence=np.full(classes.shape, 0.5, np.float32))


def without_chair(camera: Camera) -> SimpleNamespace:
    """The same with the chair shown as wall."""
    seen = seen_by(camera)
    seen.semantic = np.where(seen.semantic == CHAIR_ID, WALL_ID, seen.semantic).astype(np.int32)
    return seen


def judged(path: Path, draw: object) -> Judgement:
    scene = open_scene(path, None, up="z")
    views = [load_view(frame) for frame in scene.train_frames]
    done: list[tuple[int, int]] = []
    found = judge(draw, scene, views, read_held_back(scene, SIZE), progress=lambda *each: done.append(each))  # type: ignore[arg-type]
    assert done[-1] == (8, 8), "training views and held-out frames"
    return found


def test_a_correct_lift_agrees_with_correct_masks(scene_path: Path) -> None:
    found = judged(scene_path, seen_by)
    assert found.not_shown == ()
    assert found.trained is not None and found.trained > 0.99
    assert found.held_back is not None and found.held_back > 0.99
    score = np.mean([segment.score for frame in open_scene(scene_path, None, up="z").frames
                     for segment in frame.mask(SIZE).segments])  # fmt: skip
    assert found.calibration(np.array([0.5], np.float32))[0] > min(0.95, score - 0.05), "half of the votes, but right"
    doubt = doubt_of_frames({"masks_as_judges": found.to_json()})
    assert len(doubt) == 8 and max(doubt.values()) < 1.05 - min(0.95, score - 0.05)
    assert doubt_of_frames({"masks_as_judges": {"doubt": {"0": "x", "1": 0.5}}}) == {"1": 0.5}
    assert doubt_of_frames({}) == {}


def warning_of(found: Judgement, path: Path) -> str:
    with closing(EventWriter(path)) as events:
        found.report(events)
    (warning,) = [event for event in EventReader(path).poll() if event.kind == "warning"]
    return str(warning.data["message"])


def test_the_warning_of_a_missing_object_names_a_frame_that_shows_it(
    scene_path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = judged(scene_path, without_chair)
    (chair,) = found.not_shown
    assert (chair.name, chair.whole_class, chair.shown_as) == ("chair", True, "wall")
    assert found.trained is not None and found.trained < 0.85
    line = f"chair: seen from near in {chair.views} views, shown as wall (see frame {chair.frame})"
    assert warning_of(found, tmp_path / "events.jsonl").endswith(f"does not show: {line}")
    assert json.loads(json.dumps(found.to_json()))["not_shown"][0]["name"] == "chair"
    with caplog.at_level(logging.INFO, "plgs.lift"):
        six = tuple(replace(chair, name=f"chair of kind {number}") for number in range(6))
        many = warning_of(replace(found, not_shown=(*six, *six)), tmp_path / "many.jsonl")
    assert "not shown: " in caplog.messages[-1]
    assert many.endswith("; and 1 more") and many.count("chair") == 5  # a line for those that are alike


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
def test_a_camera_closer_than_the_photos_is_reported_as_coarse(forward: float, coarse: float) -> None:
    photo, pose = Camera(640, 480, 600.0, 600.0, 320.0, 240.0, np.eye(4)), np.eye(4)
    pose[2, 3] = forward
    shot = photo.at(pose)
    found = unresolved(seen(shot, 4.0 - forward), shot, [photo])
    assert (found.coarse, found.empty) == pytest.approx((coarse, 0.25), abs=0.02)
    small = shot.resized(80, 60)
    assert unresolved(seen(small, 4.0 - forward), small, [photo], reduced=8.0).coarse == pytest.approx(coarse, abs=0.02)


def test_surface_that_no_photo_shows_is_reported_as_unresolved() -> None:
    photo, pose = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4)), np.diag([-1.0, 1.0, -1.0, 1.0])
    assert unresolved(seen(photo.at(pose), 2.0), photo.at(pose), [photo]).coarse == pytest.approx(0.75, abs=0.02)


def test_a_large_share_of_unresolved_surface_gives_a_warning(tmp_path: Path) -> None:
    events = EventWriter(tmp_path / "events.jsonl")
    report_unresolved([], events, before=True)
    report_unresolved([("a", Unresolved(0.0, 0.05))], events, before=True)
    report_unresolved([("a", Unresolved(0.0, 0.02)), ("b", Unresolved(0.4, 0.18))], events, before=False)
    events.close()
    figures, warning = map(json.loads, (tmp_path / "events.jsonl").read_text().splitlines())
    assert figures["values"]["most"] == pytest.approx(0.58)
    assert "do not resolve 30% of the baked views (58% of b): 20% is shown" in warning["message"]
