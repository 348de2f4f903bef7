"""Which frames a lift trains on: chosen when it begins, and the same ones whenever it is resumed, on any machine."""

from __future__ import annotations

from dataclasses import replace

from ..job import Checkpoint, EventWriter, JobError, LiftRequest
from ..job.main_memory import main_memory
from ..scene import Scene, choose_frames
from ..train.progress import StageProgress
from .fitting import check_memory, frames_that_fit

FRAMES = "frames"
"""Of a checkpoint's state: the names of the frames trained on. What fits is another number on another machine."""


def scene_to_lift(
    whole: Scene, request: LiftRequest, checkpoint: Checkpoint | None, progress: StageProgress, events: EventWriter
) -> Scene:
    """The scene with the frames to train on, and all that are held out. They are those that the lift was begun with
    where a ``checkpoint`` tells.

    Raises JobError when they need too much memory, or are not in the scene any more; SceneError when a file is bad.
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
    """The names of the frames that the lift was begun with. Raises JobError when the checkpoint tells none, or the
    scene has one of them no more."""
    names = checkpoint.state[FRAMES]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        fix = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."
        raise JobError("the checkpoint tells no frames", checkpoint.path, fix)
    begun = frozenset(map(str, names))
    missing = sorted(begun.difference(frame.name for frame in scene.train_frames))
    if missing:
        what = f"the lift was begun with frame {missing[0]}, which is none to train on any more"
        raise JobError(what, scene.folder, "Put the scene back as it was, or lift into another folder.")
    return begun
