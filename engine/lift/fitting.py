"""Whether a lift fits into this machine's memory, told before it is begun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..job import EventWriter, JobError, LiftRequest
from ..job.effort import EFFORTS, Effort, chosen_effort
from ..job.main_memory import MainMemory
from ..job.prediction import Prediction, predict
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
        _tell_what_others_hold(needed, memory, events)
        return effort.most_frames
    fewer = _fewer_frames(scene, effort, masks, memory.total)
    if request.fit and fewer is not None:
        events.warning(f"memory is short: at most {fewer} frames are trained on")
        return fewer
    raise JobError(_too_much(needed, memory), scene.folder, _advice(scene, request, effort, masks, memory.total, fewer))


def check_memory(
    scene: Scene, request: LiftRequest, frames: int, memory: MainMemory | None, events: EventWriter
) -> None:
    """Of a lift that was begun with so many frames to train on, on whatever machine: their number cannot change.

    Raises JobError when they need more memory than there is; SceneError when a mask is bad.
    """
    if memory is None:
        return
    effort = chosen_effort(request.preset, request.steps, request.size, frames, request.options)
    needed = _peak(scene, effort, masks_a_frame(scene))
    if needed > memory.total:
        what = f"{_too_much(needed, memory)}: it was begun with {frames} frames"
        raise JobError(what, scene.folder, "Resume it on a machine with more memory, or lift into another folder.")
    _tell_what_others_hold(needed, memory, events)


def _tell_what_others_hold(needed: int, memory: MainMemory, events: EventWriter) -> None:
    if needed > memory.free:
        events.warning(f"the lift needs about {_gb(needed)} of memory, and only {_gb(memory.free)} are free")


def _too_much(needed: int, memory: MainMemory) -> str:
    return f"the lift needs about {_gb(needed)} of memory, and this machine has {_gb(memory.total)}"


def masks_a_frame(scene: Scene) -> float:
    """The mean number of segments, of LOOKED_AT frames. Raises SceneError."""
    frames = scene.train_frames
    places = np.unique(np.linspace(0, len(frames) - 1, min(LOOKED_AT, len(frames))).round().astype(int))
    looked_at = [frames[place] for place in places]
    return float(np.mean([len(frame.mask(size_within(frame.size, (64, 64))).segments) for frame in looked_at]))


def predicted_lift(scene: Scene, effort: Effort, masks: float, bake: str = "test") -> Prediction:
    """Of a scene whose frames have so many ``masks`` each; as if all were as large as the largest."""
    size = max((frame.size for frame in scene.frames), key=lambda size: size[0] * size[1])
    counts = len(scene.train_frames), len(scene.test_frames)
    return predict(*counts, size, effort, bake=bake, masks_a_frame=masks, classes=len(scene.classes.categories))


def _peak(scene: Scene, effort: Effort, masks: float) -> int:
    """Bytes."""
    return predicted_lift(scene, effort, masks).peak_bytes


def _fewer_frames(scene: Scene, effort: Effort, masks: float, most: int) -> int | None:
    """The most frames that fit, found in steps of a fifth; None where FEWEST_FRAMES do not."""
    views = effort.views_of(len(scene.train_frames))
    while views > FEWEST_FRAMES:
        views = max(FEWEST_FRAMES, round(0.8 * views))
        if _peak(scene, replace(effort, most_frames=views), masks) <= most:
            return views
    return None


def _advice(scene: Scene, request: LiftRequest, effort: Effort, masks: float, most: int, fewer: int | None) -> str:
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
