"""A lift from end to end: frames and input masks in, one consistent 3D panoptic scene out. The stages follow the
paper's order: read the frames, check label consistency, match the instances, train the structured Gaussians, write the
result, bake the passes, evaluate."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from .. import __version__
from ..corrections import read_edits
from ..diagnosis import Finding, diagnose_quickly
from ..errors import Cancelled, PlgsError
from ..job import Checkpoint, EventWriter, LiftFolder, StopSignal, read_manifest, write_manifest
from ..job.atomic import WRITTEN
from ..job.manifest import verify_of
from ..job.prediction import USUAL_MASKS, learn_slowness, machine_slowness
from ..job.progress import Course, StageProgress, StageReporter
from ..job.training_log import TrainingLog
from ..json_file import Json
from ..machine.code_digest import code_digest
from ..machine.log_compilation import log_compilation
from ..model.checking import read_tensors
from ..model.decoders import DECODERS
from ..model.detail import finest_pixels
from ..model.structured import StructuredScene
from ..presets.preset import Preset
from ..scene import VOID, Scene, Size, open_scene_to_lift, size_within, survey_scene
from ..scene.view import StoredViews, View, chained, load_view, read_ahead
from ..scene_of_lift import estimates_of, masks_differ, masks_last_run, refuse_changed, remember_scene, warn_of_earlier
from ..train.state import OtherLabels, restore, trainer_state
from ..train.trainer import LOSSES, Trainer
from . import lasting_names
from .baking import FrameBaker, bake_and_evaluate, corrected_baker, names_of_files
from .device import be_repeatable, usable_device
from .frame_sets import FRAMES, FrameSets, check_disk, frames_to_bake, predicted_lift, sets_of_frames
from .judging import evenly, read_held_back
from .kept_corrections import (
    FILL,
    MakeFills,
    drop_fills_of_undone,
    kept_edits,
    removals,
    report_edits,
    take_over_edits,
    with_own_fills,
)
from .live_previews import LivePreviews
from .objects import MATCHERS
from .preparation import PreparedLift, ViewsToLift, prepare
from .scene_files import instance_names, is_near_measured, shown_by_depth, shown_instances, write_scene_files
from .voting import read_voters, vote_labels

log = logging.getLogger("plgs.lift")

STAGES = {
    "check": "Checking the scene",
    "read": "Reading the frames",
    "consistency": "Building the point cloud",
    "match": "Matching instances in 3D",
    "prepare": "Placing the first Gaussians",
    "train": "Training Gaussians",
    "result": "Writing the lifted scene",
    "evaluate": "Judging the lift by its masks",
    "bake": "Baking and scoring panoptic passes",
}
STAGES_WITH_FILLS = {
    name: STAGES.get(name, "Filling where objects were removed") for name in (*[*STAGES][:-2], FILL, *[*STAGES][-2:])
}
"""The stages of a lift that keeps removals of objects."""
FILL_S = 15.0
"""Predicted seconds to make the fill of a removal."""
CHECKPOINT_EVERY_S = 20.0
"""Minimum seconds between two checkpoints. Checkpoints do not change the result."""
CHECKPOINT_SHARE = 0.02
"""The largest share of the time for checkpoints: slow ones become rarer."""
NO_VOTES = (
    "labels come from the trained decoders, not from votes of the views: "
    'votes need objects = "agreement", or a matcher that returns label_maps, and one_class_an_object = true'
)
CHECKED = (0.0, 0.25, 0.35, 0.5, 0.95, 1.0)
"""Shares of the stage "check" at which its parts begin, and its end: opening takes a third of looking at all files."""
VOTED, SIFTED = 0.8, 0.83
"""Shares of the stage "result" after voting (67 of 92 s in a small lift), and after points were left out."""
CODE = "code"
"""The name, in checkpoints and manifest, of the digest of the code that did the lift."""
TRAINING = "training"
"""The name, in checkpoints, of the options that training depends on."""
MASKS = "masks"
"""The name, in checkpoints, of the digest of the masks that the lift was trained with."""
LONG_S = 3600.0
"""Predicted seconds above which a lift warns before it trains."""
TRAINED_ANEW = "it is trained again, from the first step"
LEAST_STEPS = 100
"""Minimum steps for which the pace is remembered. Fewer would measure the first compilation, not the computer."""


def run_lift(
    folder: LiftFolder,
    events: EventWriter,
    stop: StopSignal,
    *,
    resume: bool,
    make_fills: MakeFills,
    preparing: Callable[..., PreparedLift] = prepare,
    training: Callable[..., Trainer] = Trainer,
    sources: Sequence[str] = ("engine",),
) -> None:
    """Do the lift that ``folder`` requests or, with ``resume``, the remaining part of it. ``make_fills`` makes what
    replaces objects that were removed from an earlier result (see `MakeFills`). Methods other than PLGS pass
    their own ``preparing`` and ``training``, which take the arguments of `prepare` and `Trainer`, and ``sources``:
    folders whose code's digest goes into the manifest. Raises PlgsError if the input cannot be lifted, and Cancelled if
    stopped; the lift can be resumed after that."""
    request, stages = folder.request, StageReporter(events, stop, STAGES)
    preset = request.chosen_preset
    lasting_names.refuse_names_of_no_objects(request, preset)
    device = usable_device(request.device, stages)
    be_repeatable(device)
    checkpoint = begun_alike(folder.checkpoints.latest(), preset, events) if resume else None
    parts = own_parts(preset)
    digest = code_digest(*sources)
    if parts:
        digest = hashlib.sha256(f"{digest} {sorted(parts.items())}".encode()).hexdigest()[:8]
    code = code_of(digest, checkpoint, events)
    with stages.stage("check") as progress:
        frames, masks_changed, findings = checked_frames(folder, preset, checkpoint, progress, events)
        made = folder.with_next_result()
        named_by = names_before(folder, made, checkpoint)
        earlier = None if named_by is None else lasting_names.read_earlier(named_by)
        removed = len(removals(kept_edits(read_edits(folder.path), earlier)))
    predicted = predicted_lift(frames.all, replace(preset, frames=len(frames.training)), USUAL_MASKS, request.bakes)
    stages.labels, seconds = STAGES_WITH_FILLS if removed else STAGES, {**predicted.stages, FILL: FILL_S * removed}
    stages.course = Course({name: machine_slowness() * seconds[name] for name in stages.labels if name != "check"})
    warn_if_long(stages.course, events)
    check_disk(folder.path, (frame.size for frame in frames_to_bake(frames.all, request.bakes)), events)
    with stages.stage("read") as progress:
        views, others = read_views(frames, preset, folder.path, progress, events)

    preset = preset.for_views(len(views))
    classes = frames.all.classes
    trained = None if checkpoint is None or masks_changed else checkpoint.state.get("model")
    previews = LivePreviews(folder, frames.all, events)
    given = ViewsToLift(views, classes, preset, request.seed, others, folder.path, trained, previews.show_points)
    prepared = preparing(given, stages)
    if preset.shows_votes and prepared.label_maps is None:
        preset = replace(preset, labels="decoders")
        events.warning(NO_VOTES)
    trainer = training(prepared.scene, prepared.targets, views, preset, request.seed)
    if checkpoint is not None:
        take_up(trainer, checkpoint, events, masks_changed=masks_changed)
    names: Mapping[int, str] = instance_names(prepared.instances, classes)
    previews.instances, previews.surface = shown_instances(prepared, names), prepared.cloud.xyz
    previews(trainer.scene)
    facts: dict[str, Json] = {FRAMES: list(frames.begun_with), CODE: code, MASKS: masks_last_run(folder)}
    facts[TRAINING] = training_options(request.chosen_preset)
    trainer.move_to(device)
    paces = train(trainer, folder, facts, stages, previews)
    trainer.move_to("cpu")

    with stages.stage("result") as progress:
        if preset.shows_votes:
            part = progress.part(0.0, VOTED)
            voted, in_view = vote_labels(
                trainer.scene, frames.training, prepared, preset, progress=part, scratch=folder.path
            )
            trainer.scene.voted = voted
            events.metric("objects_in_view", in_view.numbers())
        cameras = [frame.camera.resized(*size_within(frame.size, preset.size)) for frame in frames.training]
        positions = trainer.scene.anchors.position.numpy(force=True)
        trainer.scene.finest = torch.from_numpy(finest_pixels(positions, cameras))
        held_back = read_held_back(frames.chosen, preset.size, folder.path)
        measured = shown_by_depth(prepared.cloud, chained(views, held_back), progress.part(VOTED, SIFTED))
        seen = is_near_measured(prepared.cloud, prepared.instance_of_point, measured)
        if earlier is not None:
            prepared, lasting = lasting_names.keep_names(earlier, prepared, seen, trainer.scene, classes)
            names = lasting.names
            lasting_names.write_names(made, lasting, events)
        part, lifted = progress.part(SIFTED, 1.0), trainer.scene
        write_scene_files(
            made, frames.chosen, views=views, held_back=held_back, prepared=prepared, seen=seen, lifted=lifted,
            events=events, names=names, progress=part,
        )  # fmt: skip
    one_class = prepared.class_of_instance is not None
    baker_of = partial(corrected_baker, trainer.scene, classes, one_class=one_class)  # on the CPU, as later bakes
    edits = kept_edits(read_edits(folder.path), earlier)
    stages.labels = STAGES_WITH_FILLS if removals(edits) else stages.labels
    corrected, filled = with_own_fills(made, edits, earlier, stages, partial(make_fills, made, edits, baker_of))
    baker = FrameBaker(classes, trainer.scene.on(device), shown_instances(prepared, names))
    shown = baker if corrected is None else baker_of(corrected)
    wanted = frames_to_bake(frames.all, request.bakes)
    bake_and_evaluate(
        made, frames.chosen, baker, wanted, shown=shown, views=evenly(views, preset.judged), held_back=held_back,
        events=events, stages=stages, findings=findings, scored=preset.scored,
    )  # fmt: skip
    previews.clear_away()
    if earlier is not None:
        take_over_edits(folder, earlier)  # not before: until now, they would apply to the earlier result
    finish(made, preset, stages, code, parts)
    if folder.is_lifted_again:
        verify_of(made.result_path, folder.path)  # else the earlier result would stay, as if it was this one
    warn_of_earlier(folder.adopt_next_result(), events.warning)
    drop_fills_of_undone(folder)
    report_edits(folder, earlier, filled, events)
    remember_pace(paces, trainer)


def own_parts(preset: Preset) -> dict[str, str]:
    """Return, by name, the source digests of the matcher, losses and decoders that a script registered and the preset
    uses. Raises PlgsError for a name that is not registered in this process."""
    return {
        **MATCHERS.sources([preset.objects]), **LOSSES.sources(preset.losses), **DECODERS.sources([preset.head])
    }  # fmt: skip


def finish(folder: LiftFolder, preset: Preset, stages: StageReporter, code: str, parts: Mapping[str, str]) -> None:
    """Write the manifest, which completes the lift, with digests: ``code`` and, by name, ``parts``. Raises OSError."""
    write_manifest(
        folder.result_path,
        versions={**library_versions(code), **parts},
        seed=folder.request.seed,
        settings=asdict(preset),
        timings=stages.timings,
        frames={file: name for name, file in names_of_files(folder).items() if name != file},
        masks=masks_last_run(folder),
        only=WRITTEN,
        estimated=estimates_of(folder),
    )


def checked_frames(
    folder: LiftFolder, preset: Preset, checkpoint: Checkpoint | None, progress: StageProgress, events: EventWriter
) -> tuple[FrameSets, bool, tuple[Finding, ...]]:
    """Open and check the requested scene. Return its frames by purpose, whether the masks have changed since the lift
    began, and the problems found. Raises PlgsError if the scene cannot be lifted."""
    request = folder.request
    if preset.labels == "votes" and not preset.can_vote:
        events.warning(NO_VOTES)
    opening, comparing, choosing, looking, remembering = map(progress.part, CHECKED, CHECKED[1:])
    scene, before = open_scene_to_lift(request, opening), masks_last_run(folder)
    if checkpoint is not None:
        refuse_changed(folder, scene, comparing)
        before = str(checkpoint.state.get(MASKS, before))  # scene.json may be of a run that was killed since
    frames = sets_of_frames(scene, request, checkpoint, choosing, events)
    survey = survey_scene(frames.chosen, looking, preset.size)
    for warning in (*frames.chosen.warnings, *survey.warnings):
        events.warning(warning)
    for each in frames.chosen.inferred:
        log.info("inferred: %s: %s", each.about, each)
    findings = ask_what_is_wrong(folder, survey.scene, preset.size, events, stops=checkpoint is None)
    masks_changed = masks_differ(before, scene, remember_scene(folder, scene, events.warning, remembering))
    return frames.only(survey.scene), masks_changed, findings


def ask_what_is_wrong(
    folder: LiftFolder, scene: Scene, size: Size, events: EventWriter, *, stops: bool
) -> tuple[Finding, ...]:
    """Diagnose the scene, with masks within ``size``, warn of each problem, and return the problems. Raises PlgsError
    if a problem makes the lift pointless, unless ``stops`` is False or the request insists on the lift (--anyway)."""
    asked = diagnose_quickly(scene, size)
    log.info("diagnosed: %d of %d frames compared, %d findings", asked.looked, asked.frames, len(asked.findings))
    for finding in asked.findings:
        events.warning(f"{finding.cause}: {finding.text}. To mend it, {finding.option}")
    worst = asked.stopping
    if worst is not None and stops and not folder.request.anyway:
        fix = f"To mend it, {worst.option}. Or lift it with --anyway."
        raise PlgsError("wrong-for-certain", f"{worst.cause}: {worst.text}", scene.folder, fix, option="--anyway")
    return asked.findings


def read_views(
    frames: FrameSets, preset: Preset, scratch: Path, progress: StageProgress, events: EventWriter
) -> tuple[StoredViews, StoredViews]:
    """Read the frames, at training size, into ``scratch``. Return the views to train on and those that only vote.
    Raises PlgsError if they have no depth or no masks, and OSError if the disk is full."""
    training, voting = frames.training, frames.voting
    total = len(training) + len(voting)
    read = read_ahead(training, lambda frame: load_view(frame, size_within(frame.size, preset.size)))
    views = StoredViews(read, scratch, lambda done: progress(done, total))
    refuse_empty(views, frames.all)
    return views, read_voters(voting, preset, lambda done: progress(len(training) + done, total), events, scratch)


def warn_if_long(course: Course, events: EventWriter) -> None:
    """Warn if the lift is predicted, by its ``course``, to take longer than LONG_S seconds."""
    seconds = sum(course.seconds.values())
    if seconds > LONG_S:
        hours = f"{seconds / 3600:.1f} h"
        events.warning(f"this lift is predicted to take {hours} in all here; it can be stopped and resumed")


NO_EFFECT_ON_TRAINING = {"name", "trained", "judged", "scored", "vote_size"}


def training_options(preset: Preset) -> dict[str, Json]:
    """Return the preset's options that influence training, by name, as JSON values."""
    found: dict[str, Json] = json.loads(json.dumps(asdict(preset)))
    return {name: value for name, value in found.items() if name not in NO_EFFECT_ON_TRAINING}


def begun_alike(checkpoint: Checkpoint | None, preset: Preset, events: EventWriter) -> Checkpoint | None:
    """Return the checkpoint, if this preset can go on training from it; otherwise None, with a warning why not."""
    wanted = training_options(preset)
    before = {} if checkpoint is None else checkpoint.state.get(TRAINING, wanted)  # earlier versions refined nothing
    if checkpoint is None or before == wanted:
        return checkpoint
    differing = [name for name in wanted if not isinstance(before, dict) or before.get(name) != wanted[name]]
    events.warning(f"the lift was begun with another {', '.join(differing)}: {TRAINED_ANEW}")
    return None


def names_before(folder: LiftFolder, made: LiftFolder, checkpoint: Checkpoint | None) -> Path | None:
    """Return the folder of the lift whose objects' names to keep, None without any: the requested one, or ``folder``
    itself if it is lifted again, into ``made``, with another preset, which may give other objects."""
    if made == folder or checkpoint is not None:
        return folder.request.names_from
    name = folder.request.chosen_preset.name
    is_refined = read_manifest(folder.result_path).settings.get("name", name) != name
    return folder.path if is_refined else folder.request.names_from


def code_of(code: str, checkpoint: Checkpoint | None, events: EventWriter) -> str:
    """Return the sources' digest ``code``. If other code began the lift, warn, and return both digests: "old+new"."""
    begun_by = "" if checkpoint is None else str(checkpoint.state.get(CODE, "unknown"))
    if not begun_by or code in begun_by.split("+"):
        return begun_by or code
    events.warning(f"other code began this lift ({begun_by}, this is {code}): lift again before you compare results")
    return f"{begun_by}+{code}"


def take_up(trainer: Trainer, checkpoint: Checkpoint, events: EventWriter, *, masks_changed: bool) -> None:
    """Restore the trainer from a checkpoint, or leave it at the start if changed masks now give other objects or
    classes. Raises PlgsError if the checkpoint is damaged or belongs to another lift."""
    if masks_changed and not trainer.preset.shows_votes:
        events.warning(f"the masks have changed, and the finished scene depends on them by training: {TRAINED_ANEW}")
        return
    path = checkpoint.path / "trainer.safetensors"
    try:
        restore(trainer, read_tensors(path)[0], checkpoint.state)
    except OtherLabels:
        events.warning(f"the masks no longer give the objects and classes that the lift began with: {TRAINED_ANEW}")
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        fix = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."
        raise PlgsError("checkpoint-unusable", f"the checkpoint cannot be used ({error})", path, fix) from error
    log.info("resuming after step %d", trainer.step_number)


def refuse_empty(views: Sequence[View], scene: Scene) -> None:
    """Raise PlgsError if the views, at training size, have no depth or no masks at all."""
    if not any((view.depth > 0).any() for view in views):
        fix = "Lift at a larger --size, or provide denser depth."
        raise PlgsError("no-depth-left", "no depth is left at the training size", scene.folder, fix, option="--size")
    if not any((view.mask.class_map() != VOID).any() for view in views):
        fix = "Lift at a larger --size, or provide masks with larger segments."
        what = "no mask is left at the training size"
        raise PlgsError("no-masks-left", what, scene.folder, fix, option="--size")


def train(
    trainer: Trainer,
    folder: LiftFolder,
    facts: Mapping[str, Json],
    stages: StageReporter,
    show: Callable[[StructuredScene], object],
) -> list[float]:
    """Do all remaining steps; return the seconds that each took. ``show`` gets the model after each step. A checkpoint,
    with ``facts`` about the run, is written at least CHECKPOINT_EVERY_S seconds after the last one, when stopped and at
    the end, but not if a step fails, since a half-done step would then replace the last complete state."""
    steps, paces = trainer.preset.last_step, []
    with stages.stage("train") as progress, closing(TrainingLog(folder.training_path, trainer.step_number)) as losses:
        saved_at, pause = time.monotonic(), CHECKPOINT_EVERY_S
        compiled = log_compilation("the kernels of a training step", "half a minute")
        done, left = trainer.step_number / steps, None
        if stages.course is not None:
            stages.course.skip("train", done)
            left = stages.course.left("train", done, None, time.monotonic())
        if not trainer.finished:  # the first step may spend a long time compiling
            stages.events.progress("train", trainer.step_number, steps, left_s=left)
        try:
            while not trainer.finished:
                began = time.monotonic()
                report = trainer.step(stages.stop.check)
                paces.append(time.monotonic() - began)
                losses.add({**report.numbers(), "seconds": paces[-1]})
                compiled()
                if len(paces) == 1 and stages.course is not None:
                    stages.course.leave_out(paces[0])
                progress(report.step, steps, report.loss)
                show(trainer.scene)
                if (began := time.monotonic()) - saved_at > pause:
                    save_checkpoint(trainer, folder, facts)
                    saved_at = time.monotonic()
                    pause = max(CHECKPOINT_EVERY_S, (saved_at - began) / CHECKPOINT_SHARE)
        except Cancelled:
            save_checkpoint(trainer, folder, facts)
            raise
        save_checkpoint(trainer, folder, facts)
    return paces


def remember_pace(paces: Sequence[float], trainer: Trainer) -> None:
    """Store the median of ``paces``, seconds of steps (compiling hardly changes it), to predict later lifts here."""
    if len(paces) < LEAST_STEPS:
        return
    megapixels = np.mean([view.camera.width * view.camera.height for view in trainer.views]) / 1e6
    anchors = trainer.scene.anchors
    try:
        learn_slowness(median(paces), float(megapixels), len(anchors) * anchors.gaussians_per_anchor / 1e6)
    except (OSError, PlgsError) as error:  # this only affects the next prediction
        log.warning("the pace of this computer was not remembered: %s", error)


def save_checkpoint(trainer: Trainer, folder: LiftFolder, facts: Mapping[str, Json]) -> None:
    tensors, state = trainer_state(trainer)
    contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}  # safetensors refuses strides
    folder.checkpoints.save({**state, **facts}, lambda path: save_file(contiguous, path / "trainer.safetensors"))


def library_versions(code: str) -> dict[str, str]:
    """Return the versions of PLGS and of the libraries that compute the result, and the digest ``code``, by name."""
    import platform

    import cv2
    import numba
    import scipy

    libraries: dict[str, Any] = {"numpy": np, "torch": torch, "numba": numba, "scipy": scipy, "opencv": cv2}
    versions = {name: library.__version__ for name, library in libraries.items()}
    return {"plgs": __version__, "code": code, "python": platform.python_version(), **versions}
