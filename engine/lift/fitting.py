"""Whether a lift fits into this machine's memory, told before it is begun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..job import EventWriter, JobError, LiftRequest
from ..job.effort import EFFORTS, Effort, chosen_effort
from ..job.main_memory import MainMemory
from ..job.prediction import predict
from ..scene import Scene, size_within

LOOKED_AT = 8
"""Frames whose segments are counted."""
FEWEST_FRAMES = 50
"""Fewer are not proposed: a room wants about so many."""


def frames_that_fit(scene: Scene, request: LiftRequest, memory: MainMemory | None, events: EventWriter) -> int:
    """How many frames to train on at most (0: all): those that the request or its preset asks for, or, where these need
    too much memory and the request agrees, as many as fit. Warns where other programs hold what is needed.

    Raises JobError, which names the options that would make it fit; SceneError when a mask is bad.
    """
    effort = chosen_effort(request.preset, request.steps, request.size, request.frames, request.options)
    if memory is None:
        return effort.most_frames
    masks = masks_a_frame(scene)
    needed = _peak(scene, effort, masks)
    if needed <= memory.total:
        if needed > memory.free:
            events.warning(f"the lift needs about {_gb(needed)} of memory, and only {_gb(memory.free)} are free")
        return effort.most_frames
    fewer = _fewer_frames(scene, effort, masks, memory.total)
    if request.fit and fewer is not None:
        events.warning(f"memory is short: at most {fewer} frames are trained on")
        return fewer
    what = f"the lift needs about {_gb(needed)} of memory, and this machine has {_gb(memory.total)}"
    raise JobError(what, scene.folder, _advice(scene, request, effort, masks, memory.total, fewer))


def masks_a_frame(scene: Scene) -> float:
    """The mean number of segments, of LOOKED_AT frames. Raises SceneError."""
    frames = scene.train_frames
    places = np.unique(np.linspace(0, len(frames) - 1, min(LOOKED_AT, len(frames))).round().astype(int))
    looked_at = [frames[place] for place in places]
    return float(np.mean([len(frame.mask(size_within(frame.size, (64, 64))).segments) for frame in looked_at]))


def _peak(scene: Scene, effort: Effort, masks: float) -> int:
    """Bytes; of the largest frame."""
    size = max((frame.size for frame in scene.frames), key=lambda size: size[0] * size[1])
    counts = len(scene.train_frames), len(scene.test_frames)
    classes = len(scene.classes.categories)
    return predict(*counts, size, effort, masks_a_frame=masks, classes=classes).peak_bytes


def _fewer_frames(scene: Scene, effort: Effort, masks: float, most: int) -> int | None:
    """The most frames that fit, found in steps of a fifth; None where FEWEST_FRAMES do not."""
    views = effort.views_of(len(scene.train_frames))
    while views > FEWEST_FRAMES:
        views = max(FEWEST_FRAMES, round(0.8 * views))
        if _peak(scene, replace(effort, most_frames=views), masks) <= most:
            return views
    return None


def _advice(
    scene: Scene, request: LiftRequest, effort: Effort, masks: float, most: int, fewer: int | None
) -> str:
    """The options with which it would fit, beside those of the request."""
    found = [] if fewer is None else [f"--frames {fewer} (--fit finds such a number)"]
    sides = [(width, width * 3 // 4) for width in (640, 320, 200) if width < effort.size_within[0]]
    size = next((size for size in sides if _peak(scene, replace(effort, size_within=size), masks) <= most), None)
    if size is not None:
        found.append(f"--size {size[0]}x{size[1]}")
    lesser = [
        chosen_effort(name, request.steps, request.size, request.frames, request.options)
        for name in reversed(EFFORTS)
        if EFFORTS[name].steps < EFFORTS[effort.name].steps
    ]
    name = next((each.name for each in lesser if _peak(scene, each, masks) <= most), None)
    if name is not None:
        found.append(f"--preset {name}")
    if not found:
        return "Use a machine with more memory, or make the frames smaller."
    return f"Lift with {', or with '.join(found)}; or use a machine with more memory."


def _gb(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
