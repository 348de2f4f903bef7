"""Which frames of a long capture are lifted: as many as do, evenly over what the camera saw, and the sharpest.

A hand-held camera takes more pictures than a room needs. As Panoptic Lifting does, the recording is cut into windows,
and the sharpest frame of each is kept. Windows are equal in time and motion together: where the camera stands still
few frames tell all, and where it turns quickly none can be spared. The masks of the frames that are not chosen vote all
the same (``engine/lift/voters.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .frame import Frame, Scene
from .reading_ahead import read_ahead
from .sharpness import photo_detail
from .view import size_within

STEP_METRES, STEP_DEGREES = 0.8, 15.0
"""Going so far changes a view as much as turning by so much."""
CANDIDATES = 3
"""Frames of a window whose sharpness is looked at: reading does not grow with the recording."""
LOOKED_AT_WITHIN = (480, 480)


def choose_frames(scene: Scene, most: int, progress: Callable[[int, int], object] | None = None) -> Scene:
    """The scene with at most ``most`` of the frames to train on; those held out stay. ``progress`` is told of windows
    done, and their number. Raises SceneError when a picture cannot be read."""
    frames = scene.train_frames
    if len(frames) <= most:
        return scene
    groups = [candidates([frames[number] for number in group]) for group in windows(frames, most)]
    looked_at = [frame for group in groups if len(group) > 1 for frame in group]
    details = iter(read_ahead(looked_at, frame_detail))
    kept = set()
    for done, group in enumerate(groups, start=1):
        found = [next(details) for _ in group] if len(group) > 1 else [0.0]
        kept.add(group[int(np.argmax(found))].name)
        if progress is not None:
            progress(done, len(groups))
    return replace(scene, frames=tuple(frame for frame in scene.frames if frame.held_out or frame.name in kept))


def windows(frames: Sequence[Frame], most: int) -> list[NDArray[np.intp]]:
    """The numbers of the frames in each of at most ``most`` windows, equal in time and motion."""
    poses = np.array([frame.camera.camera_to_world for frame in frames])
    gone = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    cosine = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3]) / 2.0 - 0.5  # (trace - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    motion = gone / STEP_METRES + turned / STEP_DEGREES
    # A tracker that jumps is no motion: such a step counts as the longest of the usual ones.
    motion = np.minimum(motion, 10.0 * max(float(np.median(motion)), 1e-9))
    share = 0.5 * motion / max(float(motion.sum()), 1e-9) + 0.5 / len(motion)
    travelled = np.concatenate([[0.0], np.cumsum(share)]) / max(float(share.sum()), 1e-9)
    window = np.minimum((travelled * most).astype(np.int64), most - 1)
    return [np.flatnonzero(window == number) for number in np.unique(window)]


def candidates(frames: Sequence[Frame]) -> list[Frame]:
    """At most CANDIDATES of a window's frames, evenly spread."""
    places = np.unique(np.linspace(0, len(frames) - 1, min(CANDIDATES, len(frames))).round().astype(int))
    return [frames[place] for place in places]


def frame_detail(frame: Frame) -> float:
    """How sharp a frame is. Raises SceneError when its picture cannot be read."""
    return photo_detail(frame.read_colour(size_within(frame.size, LOOKED_AT_WITHIN)))
