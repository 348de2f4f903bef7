"""Which frames of a long capture are lifted."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import Camera, ClassTable, Frame, Scene, choose_frames, photo_detail
from engine.scene.frame_choice import frames_to_mask, windows

SIZE = (48, 36)
PICTURE = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
BLURRED = cv2.GaussianBlur(PICTURE, (0, 0), 2.0)


def frame(number: int, place: float, *, turn: float = 0.0, sharp: bool = True, held_out: bool = False) -> Frame:
    """A frame at ``place`` metres along a line, turned by ``turn`` degrees about the vertical."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(turn), 0.0]))[0]
    pose[0, 3] = place
    camera = Camera(*SIZE, 40.0, 40.0, SIZE[0] / 2, SIZE[1] / 2, pose)
    colour = PICTURE if sharp else BLURRED
    return Frame(f"{number:04d}", camera, held_out, Path("x.png"), None, lambda size: colour, None, None)


def scene_of(frames: Sequence[Frame]) -> Scene:
    return Scene(Path("scene"), tuple(frames), ClassTable(()))


def names(scene: Scene) -> list[int]:
    return [int(each.name) for each in scene.train_frames]


def test_every_frame_of_a_short_recording_is_used() -> None:
    scene = scene_of([frame(number, 0.1 * number) for number in range(10)])
    assert choose_frames(scene, 10) is scene


def test_the_sharpest_of_neighbouring_frames_is_chosen() -> None:
    scene = scene_of([frame(number, 0.1 * number, sharp=number % 3 == 1) for number in range(30)])
    assert names(choose_frames(scene, 10)) == list(range(1, 30, 3))
    assert photo_detail(PICTURE) > 2 * photo_detail(BLURRED)


def test_choosing_frames_keeps_held_out_frames_and_order() -> None:
    scene = scene_of([frame(number, 0.1 * number, held_out=number % 5 == 2) for number in range(40)])
    told: list[tuple[int, int]] = []
    chosen = choose_frames(scene, 8, lambda done, total: told.append((done, total)))
    assert [each.name for each in chosen.test_frames] == [each.name for each in scene.test_frames]
    assert len(chosen.train_frames) == 8 and told[-1] == (8, 8)
    assert [each.name for each in chosen.frames] == sorted(each.name for each in chosen.frames)


@pytest.mark.parametrize("turns", [True, False], ids=["turning", "going"])
def test_more_frames_are_chosen_where_the_camera_moves_more(turns: bool) -> None:
    frames = [frame(number, 0.0) for number in range(100)]
    for number in range(100):
        moved = 2.0 * number
        frames.append(frame(100 + number, 0.0 if turns else moved / 10, turn=moved if turns else 0.0))
    kept = names(choose_frames(scene_of(frames), 40))
    still, moving = sum(number < 100 for number in kept), sum(number >= 100 for number in kept)
    assert moving > 2 * still > 10


def test_a_jump_in_the_poses_does_not_distort_the_choice_of_frames() -> None:
    frames = [frame(number, 0.1 * number + (1000.0 if number >= 50 else 0.0)) for number in range(100)]
    assert len(windows(frames, 20)) >= 18


def deep(number: int, place: float, *, sharp: bool = True, held_out: bool = False) -> Frame:
    """A frame in front of a wall 2 m away, of which it sees 2.4 m."""
    seen = lambda size: np.full(size[::-1] if size else SIZE[::-1], 2.0, np.float32)  # noqa: E731
    return replace(frame(number, place, sharp=sharp, held_out=held_out), read_depth=seen)


def test_frames_to_segment_see_every_surface_five_times() -> None:
    """Forty frames that stand at two places see as much as ten sharp ones; a place that few see needs all of them."""
    frames = [deep(number, 10.0 * (number % 2), sharp=number % 4 < 2) for number in range(40)]
    frames += [deep(number, 30.0, sharp=False) for number in range(40, 43)]
    frames += [deep(number, 0.0, held_out=True) for number in range(50, 70)]
    chosen = {int(each.name) for each in frames_to_mask(scene_of(frames))}
    trained = {number for number in chosen if number < 50}
    assert len(trained) == 13 and {40, 41, 42} <= trained
    assert all(number % 4 < 2 for number in trained if number < 40), "the sharp ones"
    assert len(chosen - trained) == round(20 * 13 / 43)


def test_without_depth_masks_are_made_for_all_frames() -> None:
    scene = scene_of([frame(number, 0.0) for number in range(20)])
    assert frames_to_mask(scene) == scene.frames
