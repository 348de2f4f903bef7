"""Divides a scene's frames into those to train on, to hold out and to vote, within the memory there is. The division is
made when a lift begins, and stays the same on whichever machine it is resumed."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import ErrorCode, PlgsError
from ..job import Checkpoint, EventWriter, LiftRequest
from ..job.prediction import PIXEL, Prediction, predict
from ..job.progress import Progress
from ..job.system import MainMemory, main_memory
from ..posed.layout import of_most
from ..presets.options import with_options
from ..presets.preset import PRESETS, Preset
from ..scene import Frame, Scene, choose_frames, evenly_spread, size_within

FRAMES = "frames"
"""Key of a checkpoint's state: the names of the training frames. On another machine, other frames might fit."""


@dataclass(frozen=True, eq=False)
class FrameSets:
    """A scene's frames by purpose. ``all``: the scene with every frame. ``chosen``: the scene with only the frames for
    training and the held-out ones. ``voting``: the other frames, which only vote on labels; empty if the preset does
    not use them. ``unreadable``: names of frames chosen for training, but left out of both scenes for unreadable
    files."""

    all: Scene
    chosen: Scene
    voting: tuple[Frame, ...]
    unreadable: tuple[str, ...] = ()

    @property
    def training(self) -> tuple[Frame, ...]:
        return self.chosen.train_frames

    @property
    def begun_with(self) -> list[str]:
        """Return the names that a checkpoint stores, so that a resumed lift uses and leaves out the same frames."""
        return [*(frame.name for frame in self.training), *self.unreadable]

    def only(self, readable: Scene) -> FrameSets:
        """Return the same sets, without those chosen frames that the scene ``readable`` does not contain."""
        names = {frame.name for frame in readable.frames}
        gone = [frame for frame in self.chosen.frames if frame.name not in names]
        kept = tuple(frame for frame in self.all.frames if frame not in gone)
        unreadable = tuple(frame.name for frame in gone if not frame.held_out)
        return FrameSets(replace(self.all, frames=kept), readable, self.voting, unreadable)


def sets_of_frames(
    scene: Scene, request: LiftRequest, checkpoint: Checkpoint | None, progress: Progress, events: EventWriter
) -> FrameSets:
    """Divide the frames of a scene by purpose, the same way as the lift to resume if there is a ``checkpoint``. Raises
    PlgsError if the frames need too much memory, are no longer in the scene, or have a bad file."""
    if checkpoint is not None and FRAMES in checkpoint.state:
        begun = begun_with(scene, checkpoint)
        check_memory(scene, request, len(begun), main_memory(), events)
        kept = (frame for frame in scene.frames if frame.held_out or frame.name in begun)
        chosen = replace(scene, frames=tuple(kept))
    else:
        most = frames_that_fit(scene, request, main_memory(), events)
        chosen = choose_frames(scene, most, progress) if most else scene
    there, taken = len(scene.train_frames), len(chosen.train_frames)
    if taken < there:
        events.warning(
            f"{taken} of {there} training frames are lifted, the sharpest of each stretch of the recording; "
            "--frames takes another number, or all"
        )
    return FrameSets(scene, chosen, frames_to_vote(scene, chosen, request.chosen_preset))


def frames_to_bake(scene: Scene, bake: str) -> tuple[Frame, ...]:
    """Return the frames whose passes ``bake`` requests: for "test" the held-out ones, for "all" every frame."""
    return {"test": scene.test_frames, "all": scene.frames, "none": ()}[bake]


def frames_to_vote(scene: Scene, chosen: Scene, preset: Preset) -> tuple[Frame, ...]:
    """Return the frames that only vote: neither held out nor in ``chosen``; none unless the preset has them vote."""
    if preset.objects in ("boxes", "none") or not preset.all_frames_vote:
        return ()
    training = {frame.name for frame in chosen.train_frames}
    return tuple(frame for frame in scene.train_frames if frame.name not in training)


def begun_with(scene: Scene, checkpoint: Checkpoint) -> frozenset[str]:
    """Return the names of the frames that the lift to resume began with. Raises PlgsError if the checkpoint has none,
    or if the scene lacks one of them."""
    names = checkpoint.state[FRAMES]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        fix = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."
        raise PlgsError("checkpoint-frames", "the checkpoint names no frames", checkpoint.path, fix)
    begun = frozenset(map(str, names))
    missing = sorted(begun.difference(frame.name for frame in scene.train_frames))
    if missing:
        what = f"the lift was begun with frame {missing[0]}, which the scene no longer has for training"
        raise PlgsError("frame-gone", what, scene.folder, "Restore the scene as it was, or lift into another folder.")
    return begun


LOOKED_AT = 8
"""The number of evenly spread frames whose segments are counted."""
FEWEST_FRAMES = 50
"""The smallest number of frames that is proposed. A room needs about this many."""
LEAST_PIXEL = 5.0
"""Minimum size of passes in bytes per pixel. The smallest file of the sample's passes has 11."""


def frames_that_fit(scene: Scene, request: LiftRequest, memory: MainMemory | None, events: EventWriter) -> int:
    """Return the number of frames to train on at most (0: all): as many as the request or its preset asks for or, if
    the request allows fewer, as fit into memory. Warns if other programs hold the memory needed. Raises PlgsError if
    the frames do not fit, with the options that would make them fit, or if a mask is bad."""
    preset = request.chosen_preset
    if memory is None:
        return preset.frames
    masks = masks_a_frame(scene)
    needed = _peak(scene, preset, masks)
    if needed <= memory.total:
        _warn_of_other_programs(needed, memory, events)
        return preset.frames
    # The most frames that fit, found in steps of a fifth; None if not even FEWEST_FRAMES fit.
    fewer: int | None = None
    views = preset.views_of(len(scene.train_frames))
    while fewer is None and views > FEWEST_FRAMES:
        views = max(FEWEST_FRAMES, round(0.8 * views))
        if _peak(scene, replace(preset, frames=views), masks) <= memory.total:
            fewer = views
    if request.fit and fewer is not None:
        events.warning(f"memory is limited: at most {fewer} frames are trained on")
        return fewer
    advice = _advice(scene, request, preset, masks=masks, most=memory.total, fewer=fewer)
    named = " ".join(option for option in ("--frames", "--fit", "--size", "--preset") if option in advice)
    raise PlgsError("too-much", _too_much(needed, memory), scene.folder, advice, code=ErrorCode.NO_MEMORY, option=named)


def check_memory(
    scene: Scene, request: LiftRequest, frames: int, memory: MainMemory | None, events: EventWriter
) -> None:
    """Check the memory for a resumed lift, whose number of ``frames`` is fixed; may warn. Raises PlgsError if they need
    more memory than there is, or if a mask is bad."""
    if memory is None:
        return
    needed = _peak(scene, replace(request.chosen_preset, frames=frames), masks_a_frame(scene))
    if needed > memory.total:
        what = f"{_too_much(needed, memory)}: it was begun with {frames} frames"
        fix = "Resume it on a computer with more memory, or lift into another folder."
        raise PlgsError("too-much", what, scene.folder, fix, code=ErrorCode.NO_MEMORY)
    _warn_of_other_programs(needed, memory, events)


def check_disk(folder: Path, sizes: Iterable[tuple[int, int]], events: EventWriter) -> None:
    """Check that ``folder`` has room for one file of passes per entry of ``sizes`` (width, height, in pixels). Warns if
    they may not fit. Raises PlgsError if they cannot fit."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    pixels, free = sum(width * height for width, height in sizes), shutil.disk_usage(there).free
    if free < pixels * LEAST_PIXEL:
        what = f"the passes need at least {_gb(pixels * LEAST_PIXEL)}, but only {_gb(free)} is free on this disk"
        raise PlgsError("disk-full", what, folder, "Make room there, or bake fewer frames.", code=ErrorCode.DISK_FULL)
    if free < pixels * PIXEL:
        events.warning(f"the passes need about {_gb(pixels * PIXEL)}, but {there} has only {_gb(free)} free: make room")


def _warn_of_other_programs(needed: int, memory: MainMemory, events: EventWriter) -> None:
    if needed > memory.free:
        need = f"the lift needs about {_gb(needed)} of memory"
        events.warning(f"{need}, but only {_gb(memory.free)} is free: close other programs")


def _too_much(needed: int, memory: MainMemory) -> str:
    return f"the lift needs about {_gb(needed)} of memory, and this computer has {_gb(memory.total)}"


def masks_a_frame(scene: Scene) -> float:
    """Return the mean number of segments in LOOKED_AT frames' masks. Raises PlgsError if most masks are unreadable."""
    looked_at = {frame.name: frame for frame in evenly_spread(scene.train_frames, LOOKED_AT)}
    masks = of_most(list(looked_at), lambda name: looked_at[name].mask(size_within(looked_at[name].size, (64, 64))))
    return float(np.mean([len(mask.segments) for mask in masks.values()]))


def predicted_lift(scene: Scene, preset: Preset, masks: float, bake: str = "test") -> Prediction:
    """Predict a lift's memory and time for ``masks`` segments per frame, with all frames as large as the largest."""
    size = max((frame.size for frame in scene.frames), key=lambda size: size[0] * size[1])
    counts = len(scene.train_frames), len(scene.test_frames)
    return predict(*counts, size, preset, bake=bake, masks_a_frame=masks, classes=len(scene.classes.categories))


def _peak(scene: Scene, preset: Preset, masks: float) -> int:
    """Return the predicted peak of a lift's memory, in bytes."""
    return predicted_lift(scene, preset, masks).peak_bytes


def _advice(scene: Scene, request: LiftRequest, preset: Preset, *, masks: float, most: int, fewer: int | None) -> str:
    """Return the text of an error's fix: options that make the lift fit into ``most`` bytes (``fewer`` frames do)."""
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
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"
