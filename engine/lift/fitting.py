"""Check whether a lift fits into this computer's memory and onto its disk, before it begins."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import ErrorCode, PlgsError
from ..job import EventWriter, LiftRequest
from ..job.main_memory import MainMemory
from ..job.prediction import PIXEL, Prediction, predict
from ..posed.layout import of_most
from ..presets.options import with_options
from ..presets.preset import PRESETS, Preset
from ..scene import Scene, evenly_spread, size_within

LOOKED_AT = 8
"""The number of evenly spread frames whose segments are counted."""
FEWEST_FRAMES = 50
"""The smallest number of frames that is proposed. A room needs about this many."""
LEAST_PIXEL = 5.0
"""Bytes per pixel that passes need in any case. The smallest file of the sample's passes has 11."""


def frames_that_fit(scene: Scene, request: LiftRequest, memory: MainMemory | None, events: EventWriter) -> int:
    """The most frames to train on (0: all): as many as the request or its preset asks for. If these need too much
    memory and the request allows it, as many as fit. Warns if other programs hold the memory that is needed.

    Raises PlgsError, which names the options that would make the lift fit, or a bad mask.
    """
    preset = request.chosen_preset
    if memory is None:
        return preset.frames
    masks = masks_a_frame(scene)
    needed = _peak(scene, preset, masks)
    if needed <= memory.total:
        _warn_of_other_programs(needed, memory, events)
        return preset.frames
    fewer = _fewer_frames(scene, preset, masks, memory.total)
    if request.fit and fewer is not None:
        events.warning(f"memory is limited: at most {fewer} frames are trained on")
        return fewer
    advice = _advice(scene, request, preset, masks, memory.total, fewer)
    named = " ".join(option for option in ("--frames", "--fit", "--size", "--preset") if option in advice)
    raise PlgsError(_too_much(needed, memory), scene.folder, advice, code=ErrorCode.NO_MEMORY, option=named)


def check_memory(
    scene: Scene, request: LiftRequest, frames: int, memory: MainMemory | None, events: EventWriter
) -> None:
    """Check the memory for a lift that was begun with ``frames`` frames, whose number cannot change.

    Raises PlgsError if they need more memory than there is, or if a mask is bad.
    """
    if memory is None:
        return
    needed = _peak(scene, replace(request.chosen_preset, frames=frames), masks_a_frame(scene))
    if needed > memory.total:
        what = f"{_too_much(needed, memory)}: it was begun with {frames} frames"
        fix = "Resume it on a computer with more memory, or lift into another folder."
        raise PlgsError(what, scene.folder, fix, code=ErrorCode.NO_MEMORY)
    _warn_of_other_programs(needed, memory, events)


def check_disk(folder: Path, sizes: Iterable[tuple[int, int]], events: EventWriter) -> None:
    """Check the room for passes of these sizes (width, height) in a folder. Warns if they are likely not to fit.

    Raises PlgsError if they cannot fit.
    """
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    pixels, free = sum(width * height for width, height in sizes), shutil.disk_usage(there).free
    if free < pixels * LEAST_PIXEL:
        what = f"the passes need at least {_gb(pixels * LEAST_PIXEL)}, and {_gb(free)} of the disk are free"
        raise PlgsError(what, folder, "Make room there, or bake fewer frames.", code=ErrorCode.DISK_FULL)
    if free < pixels * PIXEL:
        events.warning(f"the passes need about {_gb(pixels * PIXEL)}, and {_gb(free)} of the disk are free")


def _warn_of_other_programs(needed: int, memory: MainMemory, events: EventWriter) -> None:
    if needed > memory.free:
        events.warning(f"the lift needs about {_gb(needed)} of memory, and only {_gb(memory.free)} are free")


def _too_much(needed: int, memory: MainMemory) -> str:
    return f"the lift needs about {_gb(needed)} of memory, and this computer has {_gb(memory.total)}"


def masks_a_frame(scene: Scene) -> float:
    """The mean number of segments in those of LOOKED_AT frames whose mask can be read. Raises PlgsError where most of
    them cannot."""
    looked_at = {frame.name: frame for frame in evenly_spread(scene.train_frames, LOOKED_AT)}
    masks = of_most(list(looked_at), lambda name: looked_at[name].mask(size_within(looked_at[name].size, (64, 64))))
    return float(np.mean([len(mask.segments) for mask in masks.values()]))


def predicted_lift(scene: Scene, preset: Preset, masks: float, bake: str = "test") -> Prediction:
    """The prediction for a scene with ``masks`` masks per frame, as if all frames were as large as the largest."""
    size = max((frame.size for frame in scene.frames), key=lambda size: size[0] * size[1])
    counts = len(scene.train_frames), len(scene.test_frames)
    return predict(*counts, size, preset, bake=bake, masks_a_frame=masks, classes=len(scene.classes.categories))


def _peak(scene: Scene, preset: Preset, masks: float) -> int:
    """The most bytes that a lift needs."""
    return predicted_lift(scene, preset, masks).peak_bytes


def _fewer_frames(scene: Scene, preset: Preset, masks: float, most: int) -> int | None:
    """The most frames that fit, found in steps of a fifth; None if not even FEWEST_FRAMES fit."""
    views = preset.views_of(len(scene.train_frames))
    while views > FEWEST_FRAMES:
        views = max(FEWEST_FRAMES, round(0.8 * views))
        if _peak(scene, replace(preset, frames=views), masks) <= most:
            return views
    return None


def _advice(scene: Scene, request: LiftRequest, preset: Preset, masks: float, most: int, fewer: int | None) -> str:
    """Advice that names the options with which the lift would fit, in addition to those of the request."""
    found = [] if fewer is None else [f"--frames {fewer} (--fit finds such a number)"]
    sides = [(width, width * 3 // 4) for width in (640, 320, 200) if width < preset.size[0]]
    size = next((size for size in sides if _peak(scene, replace(preset, size=size), masks) <= most), None)
    if size is not None:
        found.append(f"--size {size[0]}x{size[1]}")
    lesser = [
        with_options(PRESETS[name], request.options)
        for name in reversed(PRESETS)
        if PRESETS[name].steps < PRESETS[preset.name].steps
    ]
    name = next((each.name for each in lesser if _peak(scene, each, masks) <= most), None)
    if name is not None:
        found.append(f"--preset {name}")
    if not found:
        return "Use a computer with more memory, or make the frames smaller."
    return f"Lift with {', or with '.join(found)}; or use a computer with more memory."


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"
