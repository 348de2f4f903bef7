"""A lift from end to end: frames and input masks in, one consistent 3D panoptic scene out.

The stages have the paper's order: read the frames, check label consistency, match the instances, train the structured
Gaussians, write the result, bake the passes, evaluate.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from statistics import median

import numpy as np
import torch
from safetensors.torch import save_file

from ..errors import Cancelled, PlgsError
from ..job import Checkpoint, EventWriter, LiftFolder, LiftRequest, StopSignal, write_manifest
from ..job.prediction import USUAL_MASKS, learn_slowness, machine_slowness
from ..machine.log_compilation import log_compilation
from ..model.settling import OwnedPoints
from ..model.structured import StructuredScene
from ..model.tensor_file import read_tensors
from ..presets.preset import Preset
from ..raster import drawing_on
from ..scene import (
    VOID,
    Frame,
    Scene,
    StoredViews,
    View,
    check_scene,
    load_view,
    open_scene_to_lift,
    read_ahead,
    size_within,
)
from ..scene.blocks import scene_of_block
from ..scene_of_lift import have_masks_changed, remember_scene
from ..train.progress import Course, StageReporter
from ..train.state import OtherLabels, restore, trainer_state
from ..train.trainer import Trainer
from .baking import FrameBaker, bake_and_evaluate
from .device import be_repeatable, refuse_missing_device
from .fitting import predicted_lift
from .lasting_names import keep_names, read_earlier, take_over_edits, write_names
from .live_previews import LivePreviews
from .method import Method, method_in_use
from .scene_files import instance_names, shown_instances, write_scene_files
from .training_frames import FRAMES, scene_to_lift
from .voters import frames_to_vote, read_voters
from .voting import vote_labels

log = logging.getLogger("plgs.lift")

STAGES = {
    "check": "Checking the scene",
    "read": "Reading the frames",
    "consistency": "Checking label consistency",
    "match": "Matching instances in 3D",
    "train": "Training the structured Gaussians",
    "result": "Writing the lifted scene",
    "bake": "Baking panoptic passes",
    "evaluate": "Evaluating the held-out frames",
}
CHECKPOINT_EVERY_S = 20.0
"""Seconds between two checkpoints: the most work that a kill loses. Checkpoints do not change the result."""
NO_VOTES = (
    "the finished scene shows the label decoders, not the views' votes: "
    'votes need objects = "agreement" and one_class_an_object = true'
)
TRAINED_ANEW = "it is trained anew, from the first step"
LEAST_STEPS = 100
"""Steps from which their pace is remembered. Fewer measure the first compilation, not the computer."""


def run_lift(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """Do the lift that ``folder`` asks for, or what is left of it.

    Raises PlgsError for input that cannot be lifted, and Cancelled when stopped. The folder can then be resumed.
    """
    request = folder.request
    preset = request.chosen_preset
    refuse_missing_device(request.device)
    refuse_names_of_no_objects(request, preset)
    method = method_in_use()
    method.refuse_bad_options(preset)
    be_repeatable(request.device)
    stages = StageReporter(events, stop, STAGES)
    with drawing_on(request.device):
        do_stages(folder, preset, stages, method, resume=resume)


def do_stages(folder: LiftFolder, preset: Preset, stages: StageReporter, method: Method, *, resume: bool) -> None:
    """``STAGES``, one after another."""
    request, events = folder.request, stages.events
    checkpoint = folder.checkpoints.latest() if resume else None

    with stages.stage("check") as progress:
        if preset.labels == "votes" and not preset.can_vote:
            events.warning(NO_VOTES)
        whole = open_scene_to_lift(request)
        masks_changed = have_masks_changed(folder, whole)
        remember_scene(folder, whole)
        if request.block:
            whole = scene_of_block(whole, request.blocks, request.block, progress)
        earlier = None if request.names_from is None else read_earlier(request.names_from)
        scene = scene_to_lift(whole, request, checkpoint, progress, events)
        for warning in (*scene.warnings, *check_scene(scene, progress)):
            events.warning(warning)
    stages.course = expected_course(whole, len(scene.train_frames), preset, request.bake)
    with stages.stage("read") as progress:
        frames, voting = scene.train_frames, frames_to_vote(whole, scene, preset)
        total = len(frames) + len(voting)
        read = read_ahead(frames, lambda frame: load_view(frame, size_within(frame.size, preset.size)))
        views = StoredViews(read, folder.path, lambda done: progress(done, total))
        refuse_empty(views, scene)
        others = read_voters(voting, preset, lambda done: progress(len(frames) + done, total), events, folder.path)

    preset = preset.for_views(len(views))
    prepared = method.prepare(views, scene.classes, preset, request.seed, stages, folder.path, others)
    trainer = method.trainer(prepared, views, preset, request.seed)
    if checkpoint is not None:
        if masks_changed and not preset.shows_votes:
            events.warning(f"the masks have changed, which the finished scene shows by training: {TRAINED_ANEW}")
        else:
            take_up(trainer, checkpoint, events)
        log.info("resuming after step %d", trainer.step_number)
    names: Mapping[int, str] = instance_names(prepared.instances, scene.classes)
    previews = LivePreviews(folder, whole, shown_instances(prepared, names), events)
    paces = train(trainer, folder, [frame.name for frame in frames], stages, previews)

    with stages.stage("result") as progress:
        prepared = method.finish(trainer, prepared, scene.classes, progress)
        if preset.shows_votes:
            maps = prepared.label_maps
            assert maps is not None  # objects by agreement come with them
            points = OwnedPoints(prepared.cloud.xyz, prepared.instance_of_point)
            trainer.scene.voted = vote_labels(trainer.scene, frames, maps, preset, progress, points, folder.path)
        if earlier is not None:
            prepared, lasting = keep_names(earlier, prepared, trainer.scene, scene.classes)
            names = lasting.names
            write_names(folder, lasting, events)
        write_scene_files(folder, scene, views, prepared, trainer.scene, events, names)
        if earlier is not None and earlier.edits:
            take_over_edits(folder, earlier, events)
    baker = FrameBaker(scene.classes, trainer.scene, shown_instances(prepared, names))
    wanted = frames_to_bake(whole, request.bake)
    bake_and_evaluate(folder, scene, baker, wanted, views, preset.size, events, stages)
    previews.clear_away()
    write_manifest(
        folder.result_path,
        versions=library_versions(),
        seed=request.seed,
        settings=asdict(preset),
        timings=stages.timings,
    )
    remember_pace(paces, trainer)


def expected_course(whole: Scene, views: int, preset: Preset, bake: str) -> Course:
    """How long the stages after the check take when ``views`` frames of the scene are lifted."""
    seconds = predicted_lift(whole, replace(preset, frames=views), USUAL_MASKS, bake).stages
    slowness = machine_slowness()
    return Course({name: slowness * value for name, value in seconds.items() if name not in ("start", "check")})


def refuse_names_of_no_objects(request: LiftRequest, preset: Preset) -> None:
    """Raise PlgsError where an earlier lift's names are asked for, but the lift has no objects."""
    if request.names_from is not None and preset.objects == "none":
        fix = "Leave out --names-from, or take objects by agreement or boxes."
        what = 'there are no objects to keep names with objects = "none"'
        raise PlgsError(what, request.names_from, fix, option="--names-from")


def take_up(trainer: Trainer, checkpoint: Checkpoint, events: EventWriter) -> None:
    """Continue from a checkpoint, or begin anew where the masks give other objects or classes than they did. Raises
    PlgsError for a checkpoint that is damaged, or another lift's."""
    path = checkpoint.path / "trainer.safetensors"
    try:
        restore(trainer, read_tensors(path)[0], checkpoint.state)
    except OtherLabels:
        events.warning(f"the masks give other objects or classes than when the lift was begun: {TRAINED_ANEW}")
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        fix = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."
        raise PlgsError(f"the checkpoint cannot be used ({error})", path, fix) from error


def refuse_empty(views: Sequence[View], scene: Scene) -> None:
    """Raise PlgsError when no depth, or no mask, is left at the size of training."""
    if not any((view.depth > 0).any() for view in views):
        fix = "Lift at a larger --size, or give denser depth."
        raise PlgsError("no depth is left at the size of training", scene.folder, fix, option="--size")
    if not any((view.mask.class_map() != VOID).any() for view in views):
        fix = "Lift at a larger --size, or give masks with larger segments."
        raise PlgsError("nothing of the masks is left at the size of training", scene.folder, fix, option="--size")


def frames_to_bake(scene: Scene, bake: str) -> tuple[Frame, ...]:
    """The frames whose passes were asked for: "test", "all" or "none"."""
    return {"test": scene.test_frames, "all": scene.frames, "none": ()}[bake]


def train(
    trainer: Trainer,
    folder: LiftFolder,
    frames: Sequence[str],
    stages: StageReporter,
    show: Callable[[StructuredScene], object],
) -> list[float]:
    """Do all steps that are left, and return the seconds of each. ``frames`` are the names of those trained on;
    ``show`` is called with the model after each step.

    A checkpoint is written every CHECKPOINT_EVERY_S seconds, when stopped, and at the end. None is written when a step
    fails, as half a step's changes would replace the last whole state.
    """
    steps, paces = trainer.preset.steps, []
    with stages.stage("train") as progress:
        saved_at = time.monotonic()
        compiled = log_compilation("the kernels of a training step", "half a minute")
        done, left = trainer.step_number / steps, None
        if stages.course is not None:
            stages.course.skip("train", done)
            left = stages.course.left("train", done, None, time.monotonic())
        if not trainer.finished:  # the first step may compile for long
            stages.events.progress("train", trainer.step_number, steps, left_s=left)
        try:
            while not trainer.finished:
                began = time.monotonic()
                report = trainer.step(stages.stop.check)
                paces.append(time.monotonic() - began)
                compiled()
                if len(paces) == 1 and stages.course is not None:
                    stages.course.leave_out(paces[0])
                progress(report.step, steps, report.loss)
                show(trainer.scene)
                if time.monotonic() - saved_at > CHECKPOINT_EVERY_S:
                    save_checkpoint(trainer, folder, frames)
                    saved_at = time.monotonic()
        except Cancelled:
            save_checkpoint(trainer, folder, frames)
            raise
        save_checkpoint(trainer, folder, frames)
    return paces


def remember_pace(paces: Sequence[float], trainer: Trainer) -> None:
    """Remember the median step for the next prediction on this computer. It neither compiled nor made pseudo labels."""
    if len(paces) < LEAST_STEPS:
        return
    megapixels = np.mean([view.camera.width * view.camera.height for view in trainer.views]) / 1e6
    anchors = trainer.scene.anchors
    try:
        learn_slowness(median(paces), float(megapixels), len(anchors) * anchors.gaussians_per_anchor / 1e6)
    except (OSError, PlgsError) as error:  # it matters for the next lift only
        log.warning("the pace of this computer was not remembered: %s", error)


def save_checkpoint(trainer: Trainer, folder: LiftFolder, frames: Sequence[str]) -> None:
    tensors, facts = trainer_state(trainer)
    facts[FRAMES] = list(frames)
    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    folder.checkpoints.save(facts, lambda path: save_file(contiguous, path / "trainer.safetensors"))


def library_versions() -> dict[str, str]:
    """Versions of the libraries that computed the result."""
    import platform

    import cv2
    import numba
    import scipy

    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "numba": numba.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
    }
