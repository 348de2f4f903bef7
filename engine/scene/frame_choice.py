"""Choose which frames of a long capture to lift: enough of them, evenly along the camera's path, and the sharpest.

As in Panoptic Lifting, the recording is cut into windows, and the sharpest frame of each is kept. Windows are equal in
time and motion combined: a camera that stands still needs few frames, and one that turns quickly needs all. The masks
of the other frames still vote (``engine/lift/voting.py``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from heapq import heappop, heappush
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
    """Return the scene with at most ``most`` training frames; held-out frames stay. ``progress`` counts windows."""
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
    """Cut the frames into at most ``most`` windows, equal in time and motion. Returns the frame indices of each."""
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
    """Return at most ``most`` of the items, evenly spaced, including the first and the last."""
    places = np.unique(np.linspace(0, len(listed) - 1, min(most, len(listed))).round().astype(int))
    return [listed[place] for place in places]


CELL = 0.4  # side in metres of the cubes of space whose surfaces are counted as one
TIMES, LEFT = 5, 0.005  # views wanted of each cube, and the share of all these views that may be missing
_SEEN_WITHIN = (64, 64)  # maximum (width, height) in pixels at which a frame's depth is looked at
_AROUND = 9  # frames with which a frame's sharpness is compared


def frames_to_mask(scene: Scene, progress: Progress = unwatched) -> tuple[Frame, ...]:
    """Return the sharpest training frames that together see every surface TIMES times, or as often as all frames see
    it; a share LEFT of these sightings may be missing. As large a share of the held-out frames as of the training
    frames is added, evenly spread. If a training frame has no depth, all are chosen. Raises PlgsError for bad depth."""
    frames = scene.train_frames
    if not frames or any(frame.read_depth is None for frame in frames):
        return scene.frames
    seen, details = [], []
    for number, frame in enumerate(frames):
        progress(number, len(frames))
        seen.append(_cells_of(frame))
        details.append(frame_detail(frame))
    _, cell = np.unique(np.concatenate(seen), return_inverse=True)
    rows = np.split(cell, np.cumsum([len(each) for each in seen])[:-1])
    usual = [np.percentile(details[max(0, each - _AROUND // 2) :][:_AROUND], 75) for each in range(len(frames))]
    sharpness = np.minimum(np.array(details) / np.maximum(usual, 1e-9), 1.0)
    missing = np.minimum(np.bincount(cell), TIMES)
    most, chosen = LEFT * missing.sum(), set[str]()
    waiting = [(-np.inf, number) for number in range(len(frames))]
    while missing.sum() > most:
        _, number = heappop(waiting)
        gain = float(sharpness[number] * np.count_nonzero(missing[rows[number]]))
        if waiting and -gain > waiting[0][0]:  # a frame's gain only falls, so those behind the next cannot beat it
            heappush(waiting, (-gain, number))
            continue
        chosen.add(frames[number].name)
        missing[rows[number]] = np.maximum(missing[rows[number]] - 1, 0)
    held_out = round(len(scene.test_frames) * len(chosen) / len(frames))
    chosen |= {frame.name for frame in evenly_spread(scene.test_frames, held_out)}
    return tuple(frame for frame in scene.frames if frame.name in chosen)


def _cells_of(frame: Frame) -> NDArray[np.int64]:
    """Return the numbers of the grid cells whose surfaces a frame's depth shows, each once, int64 [n]."""
    size = size_within(frame.size, _SEEN_WITHIN)
    depth = frame.depth(size)
    place = np.floor(frame.camera.resized(*size).unproject(depth)[depth > 0] / CELL).astype(np.int64) + (1 << 20)
    return np.unique(place @ (1 << np.array([42, 21, 0], np.int64)))


def frame_detail(frame: Frame) -> float:
    """Return a frame's sharpness (`photo_detail`); the lowest value if its picture cannot be read."""
    try:
        return photo_detail(frame.read_colour(size_within(frame.size, LOOKED_AT_WITHIN)))
    except PlgsError:  # the later check of the chosen frames reports the error
        return -1.0


def photo_detail(photo: NDArray[np.uint8]) -> float:
    """Return how detailed a photo uint8 [H, W, 3] is: the mean absolute Laplacian over the mean brightness, so that
    exposure does not matter. A blurred photo has less detail than its neighbours, which show about the same."""
    import cv2

    grey = photo.mean(axis=2, dtype=np.float32)
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean() / (grey.mean() + 1.0))
