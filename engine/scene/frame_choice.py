"""Which frames of a long capture are lifted: enough of them, evenly along the camera's path, and the sharpest.

As in Panoptic Lifting, the recording is cut into windows, and the sharpest frame of each is kept. Windows are equal in
time and motion combined: a camera that stands still needs few frames, and one that turns quickly needs all. The masks
of the other frames still vote (``engine/lift/voting.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job.progress import Progress, unwatched
from ..posed import size_within
from .frame import Frame, Scene
from .view import read_ahead

Listed = TypeVar("Listed")

STEP_METRES, STEP_DEGREES = 0.8, 15.0  # moving by this length changes a view as much as turning by this angle
CANDIDATES = 3  # frames per window whose sharpness is measured, so that reading does not grow with the recording
LOOKED_AT_WITHIN = (480, 480)  # maximum (width, height) in pixels at which sharpness is measured


def choose_frames(scene: Scene, most: int, progress: Progress = unwatched) -> Scene:
    """The scene with at most ``most`` training frames; those held out stay. ``progress`` counts windows."""
    frames = scene.train_frames
    if len(frames) <= most:
        return scene
    groups = [evenly_spread([frames[number] for number in group], CANDIDATES) for group in windows(frames, most)]
    looked_at = [frame for group in groups if len(group) > 1 for frame in group]
    details = iter(read_ahead(looked_at, frame_detail))
    kept = set()
    for done, group in enumerate(groups, start=1):
        found = [next(details) for _ in group] if len(group) > 1 else [0.0]
        kept.add(group[int(np.argmax(found))].name)
        progress(done, len(groups))
    return replace(scene, frames=tuple(frame for frame in scene.frames if frame.held_out or frame.name in kept))


def windows(frames: Sequence[Frame], most: int) -> list[NDArray[np.intp]]:
    """The numbers of the frames in each of at most ``most`` windows, equal in time and motion."""
    poses = np.array([frame.camera.camera_to_world for frame in frames])
    gone = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    cosine = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3]) / 2.0 - 0.5  # (trace - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    motion = gone / STEP_METRES + turned / STEP_DEGREES
    # A jump of the tracker is not motion: such a step counts as the longest of the usual ones.
    motion = np.minimum(motion, 10.0 * max(float(np.median(motion)), 1e-9))
    share = 0.5 * motion / max(float(motion.sum()), 1e-9) + 0.5 / len(motion)
    travelled = np.concatenate([[0.0], np.cumsum(share)]) / max(float(share.sum()), 1e-9)
    window = np.minimum((travelled * most).astype(np.int64), most - 1)
    return [np.flatnonzero(window == number) for number in np.unique(window)]


def evenly_spread(listed: Sequence[Listed], most: int) -> list[Listed]:
    """At most ``most`` of the items, including the first and the last."""
    places = np.unique(np.linspace(0, len(listed) - 1, min(most, len(listed))).round().astype(int))
    return [listed[place] for place in places]


def frame_detail(frame: Frame) -> float:
    """A frame's sharpness; the lowest value if its picture cannot be read."""
    try:
        return photo_detail(frame.read_colour(size_within(frame.size, LOOKED_AT_WITHIN)))
    except PlgsError:  # whoever checks the chosen frames names it
        return -1.0


def photo_detail(photo: NDArray[np.uint8]) -> float:
    """The detail of a photo uint8 [H, W, 3]: the mean absolute Laplacian over the mean brightness, so that exposure
    does not matter. A blurred photo has less detail than its neighbours, which show about the same."""
    import cv2

    grey = photo.mean(axis=2, dtype=np.float32)
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean() / (grey.mean() + 1.0))
