"""The frames that a lift trains on. They are chosen when it begins, and stay the same when it is resumed anywhere."""

from __future__ import annotations

from dataclasses import replace

from ..errors import PlgsError
from ..job import Checkpoint, EventWriter, LiftRequest
from ..job.main_memory import main_memory
from ..scene import Scene, choose_frames
from ..train.progress import StageProgress
from .fitting import check_memory, frames_that_fit

FRAMES = "frames"
"""Key of a checkpoint's state: the names of the frames trained on. On another machine other frames might fit."""


def scene_to_lift(
    whole: Scene, request: LiftRequest, checkpoint: Checkpoint | None, progress: StageProgress, events: EventWriter
) -> Scene:
    """The scene with the frames to train on, and all that are held out. A ``checkpoint`` names the frames that the lift
    was begun with.

    Raises PlgsError when they need too much memory, are not in the scene any more, or a file is bad.
    """
    if checkpoint is not None and FRAMES in checkpoint.state:
        begun = begun_with(whole, checkpoint)
        check_memory(whole, request, len(begun), main_memory(), events)
        kept = (frame for frame in whole.frames if frame.held_out or frame.name in begun)
        chosen = replace(whole, frames=tuple(kept))
    else:
        most = frames_that_fit(whole, request, main_memory(), events)
        chosen = choose_frames(whole, most, progress) if most else whole
    there, taken = len(whole.train_frames), len(chosen.train_frames)
    if taken < there:
        events.warning(
            f"of {there} frames to train on {taken} are lifted, the sharpest of each stretch of the recording; "
            "--frames takes another number, or all"
        )
    return chosen


def begun_with(scene: Scene, checkpoint: Checkpoint) -> frozenset[str]:
    """The names of the frames that the lift was begun with. Raises PlgsError when the checkpoint has none, or the scene
    lacks one of them."""
    names = checkpoint.state[FRAMES]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        fix = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."
        raise PlgsError("the checkpoint names no frames", checkpoint.path, fix)
    begun = frozenset(map(str, names))
    missing = sorted(begun.difference(frame.name for frame in scene.train_frames))
    if missing:
        what = f"the lift was begun with frame {missing[0]}, which the scene no longer has for training"
        raise PlgsError(what, scene.folder, "Put the scene back as it was, or lift into another folder.")
    return begun
