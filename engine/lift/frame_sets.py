"""The frames of a lift by their purpose. They are chosen when it begins, and stay the same on whichever machine it is
resumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..errors import PlgsError
from ..job import Checkpoint, EventWriter, LiftRequest
from ..job.main_memory import main_memory
from ..presets.preset import Preset
from ..scene import Frame, Scene, choose_frames
from ..train.progress import StageProgress
from .fitting import check_memory, frames_that_fit

FRAMES = "frames"
"""Key of a checkpoint's state: the names of the training frames. On another machine, other frames might fit."""


@dataclass(frozen=True, eq=False)
class FrameSets:
    """``all``: the scene with every frame. ``chosen``: the scene with those that are trained on or held out.
    ``voting``: those that are neither, and vote; empty if the preset has no use for them. ``unreadable`` names frames
    that were chosen to train on, and left out of ``all`` and ``chosen`` as their files cannot be read."""

    all: Scene
    chosen: Scene
    voting: tuple[Frame, ...]
    unreadable: tuple[str, ...] = ()

    @property
    def training(self) -> tuple[Frame, ...]:
        return self.chosen.train_frames

    @property
    def begun_with(self) -> list[str]:
        """What a checkpoint notes: a resumed lift chooses, checks and leaves out the same frames."""
        return [*(frame.name for frame in self.training), *self.unreadable]

    def only(self, readable: Scene) -> FrameSets:
        """The sets without the chosen frames that the scene ``readable`` lacks."""
        names = {frame.name for frame in readable.frames}
        gone = [frame for frame in self.chosen.frames if frame.name not in names]
        kept = tuple(frame for frame in self.all.frames if frame not in gone)
        unreadable = tuple(frame.name for frame in gone if not frame.held_out)
        return FrameSets(replace(self.all, frames=kept), readable, self.voting, unreadable)

    @property
    def held_out(self) -> tuple[Frame, ...]:
        return self.chosen.test_frames


def sets_of_frames(
    scene: Scene, request: LiftRequest, checkpoint: Checkpoint | None, progress: StageProgress, events: EventWriter
) -> FrameSets:
    """The frames of a scene by their purpose. A ``checkpoint`` names those that the lift was begun with.

    Raises PlgsError if they need too much memory, are no longer in the scene, or a file is bad.
    """
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
    """The frames whose passes were requested: "test", "all" or "none"."""
    return {"test": scene.test_frames, "all": scene.frames, "none": ()}[bake]


def frames_to_vote(scene: Scene, chosen: Scene, preset: Preset) -> tuple[Frame, ...]:
    """The frames of a scene that are neither held out nor among the ``chosen``."""
    if preset.objects != "agreement" or not preset.all_frames_vote:
        return ()
    training = {frame.name for frame in chosen.train_frames}
    return tuple(frame for frame in scene.train_frames if frame.name not in training)


def begun_with(scene: Scene, checkpoint: Checkpoint) -> frozenset[str]:
    """The names of the frames that the lift was begun with. Raises PlgsError if the checkpoint has none, or the scene
    lacks one of them."""
    names = checkpoint.state[FRAMES]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        fix = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."
        raise PlgsError("the checkpoint names no frames", checkpoint.path, fix)
    begun = frozenset(map(str, names))
    missing = sorted(begun.difference(frame.name for frame in scene.train_frames))
    if missing:
        what = f"the lift was begun with frame {missing[0]}, which the scene no longer has for training"
        raise PlgsError(what, scene.folder, "Restore the scene as it was, or lift into another folder.")
    return begun
