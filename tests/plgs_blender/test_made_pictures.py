"""What an engine made of a scene, told apart from what it made of other cameras."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from plgs.engine.known_scene import MadeFrames, stored_scene
from plgs.engine.posed import Camera, ClassTable
from plgs.engine.posed.frames import PosedFrame, PosedScene
from plgs.engine.scene_source import SceneSource
from plgs.plgs_blender.frame_pictures import has_cameras_of

SCENE = Path("/scene")


def frames_of(count: int) -> list[PosedFrame]:
    poses = [np.eye(4) + np.pad([[number / 7.0]], ((0, 3), (3, 0))) for number in range(count)]
    cameras = [Camera(640, 480, 500.0, 501.0, 320.0, 240.0, pose) for pose in poses]
    return [
        PosedFrame(f"{number:04}", camera, False, SCENE / "color" / f"{number:04}.jpg", None)
        for number, camera in enumerate(cameras)
    ]


def made_of_frames(frames: list[PosedFrame]) -> MadeFrames:
    scene = PosedScene(SCENE, tuple(frames), ClassTable(()))
    return MadeFrames(Path("/made"), SceneSource(SCENE), stored_scene(scene, frames))


def test_only_frames_that_both_have_are_compared() -> None:
    frames = frames_of(6)
    made = made_of_frames(frames[1:5])
    assert has_cameras_of(made, frames) and has_cameras_of(made, frames[3:])
    assert not has_cameras_of(made, frames[5:]) and not has_cameras_of(made, [])
    camera = frames[2].camera
    pose = camera.camera_to_world.copy()
    pose[2, 3] += 0.001
    for other in (camera.at(pose), replace(camera, width=641), replace(camera, cy=240.5), replace(camera, fx=499.0)):
        assert not has_cameras_of(made, [*frames[:2], replace(frames[2], camera=other), *frames[3:]])


def test_the_cameras_of_a_long_recording_are_compared_without_a_halt() -> None:
    """Blender's window waits for it: one comparison for each frame took 0.3 s."""
    frames = frames_of(2000)
    made, took = made_of_frames(frames), []
    for _ in range(3):
        before = time.process_time()
        assert has_cameras_of(made, frames)
        took.append(time.process_time() - before)
    assert min(took) < 0.1, took
