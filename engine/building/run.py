"""The lift of a building: its blocks one after another, each an ordinary lift in its own process, then the join.

A block's lift is in ``blocks/<number>`` of the lift folder. It may have been made elsewhere before, with
`engine lift SCENE -o OUT/blocks/2 --blocks 5 --block 2`: finished lifts are used as they are.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..corrections import read_edits
from ..errors import Cancelled, ErrorCode, PlgsError
from ..job import EventWriter, LiftFolder, LiftRequest, StopSignal, read_manifest
from ..job.folder import BLOCKS
from ..job.follower import TaskFollower
from ..job.process import engine_command
from ..job.task import LIFT, TaskState
from ..lift.baking import FrameBaker, bake_and_evaluate
from ..lift.device import be_repeatable, refuse_missing_device
from ..lift.frame_sets import frames_to_bake
from ..lift.judging import read_held_back
from ..lift.kept_preparation import refused_in
from ..lift.run import CODE, finish, tell
from ..lift.scene_files import read_model, write_lifted
from ..machine.code_digest import code_digest
from ..passes.baked_view import ShownInstances
from ..posed.layout import listed
from ..presets.preset import Preset
from ..raster import drawing_on
from ..result_files import INSTANCES, SEMANTIC_POINTS, SemanticPoints, read_arrays, read_instances
from ..scene import StoredViews, load_view, open_scene_to_lift, size_within, survey_scene
from ..scene.blocks import Cell, cells_of
from ..scene_of_lift import is_done, refuse_changed, remember_blocks, remember_scene
from ..train.progress import StageProgress, StageReporter
from .joining import JoinedScene, LiftedBlock, join

STAGES = {
    "check": "Checking the scene",
    "cut": "Cutting the scene into blocks",
    "blocks": "Lifting the blocks",
    "join": "Joining the blocks",
    "evaluate": "Judging the lift by its masks",
    "bake": "Baking and scoring panoptic passes",
}
LOOK_EVERY_S = 0.1
JUDGES = 100
"""The most training frames whose masks judge the whole, evenly spread."""


def run_building(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """`run_lift` for a building: do what is left of it, whether it is resumed or not."""
    request, preset = folder.request, folder.request.chosen_preset
    refuse_missing_device(request.device, StageReporter(events, stop, STAGES))
    if not preset.shows_votes or request.names_from is not None:
        what = "blocks are joined by the views' votes, and cannot keep the names of an earlier lift"
        raise PlgsError(what, folder.path, "Lift without --blocks.", option="--blocks")
    be_repeatable(request.device)
    with drawing_on(request.device):
        _do_stages(folder, preset, StageReporter(events, stop, STAGES))


def _do_stages(folder: LiftFolder, preset: Preset, stages: StageReporter) -> None:
    """Do the ``STAGES``, one after another."""
    request, events = folder.request, stages.events
    with stages.stage("check") as progress:
        opened = open_scene_to_lift(request)
        if (folder.path / BLOCKS).exists():
            refuse_changed(folder, opened)
        survey = survey_scene(opened, progress)
        tell(opened, survey, events)
        masks = remember_scene(folder, opened, events.warning)
        scene = survey.scene
    with stages.stage("cut") as progress:
        cells, _ = cells_of(opened, request.blocks, progress)  # as each block cuts them
    with stages.stage("blocks") as progress:
        lifts = [lift_block(folder, number, progress, masks) for number in range(1, request.blocks + 1)]
        if corrected := [lift.path.name for lift in lifts if not all(edit.undone for edit in read_edits(lift.path))]:
            events.warning(f"corrections of block {listed(corrected)} are not taken over: correct the joined lift")
        remember_blocks(folder, events.warning)
    with stages.stage("join") as progress:
        whole = join([read_block(lift, cell) for lift, cell in zip(lifts, cells, strict=True)], scene.classes)
        viewpoint = np.mean([frame.camera.centre for frame in scene.train_frames], axis=0)
        write_lifted(folder, scene.classes, viewpoint, whole.points, whole.instances, whole.model, events, progress)
        progress(1, 1)
    baker = FrameBaker(scene.classes, whole.model, shown_of(whole))
    every = -(-len(scene.train_frames) // JUDGES)
    judges = (load_view(frame, size_within(frame.size, preset.size)) for frame in scene.train_frames[::every])
    views = StoredViews(judges, folder.path)
    wanted, held_back = frames_to_bake(scene, request.bake), read_held_back(scene, preset.size, folder.path)
    tried = ((one, cell) for lift, cell in zip(lifts, cells, strict=True) for one in refused_in(lift))
    refused = [one for one, cell in tried if cell.contains(np.array([one.finding.centre])).all()]
    bake_and_evaluate(folder, scene, baker, wanted, views, held_back, events, stages, refused)
    named = [str(read_manifest(lift.result_path).versions.get(CODE, "unknown")) for lift in lifts]
    finish(folder, preset, stages, "+".join(sorted({code_digest("engine"), *"+".join(named).split("+")})))


def shown_of(whole: JoinedScene) -> ShownInstances:
    """The names of the objects, and their classes."""
    named = {one.id: one.name for one in whole.instances}
    return ShownInstances(named, {one.id: one.class_id for one in whole.instances})


def request_of_block(request: LiftRequest, number: int) -> LiftRequest:
    """The request for a block's lift."""
    return replace(request, block=number, bake="none")


def lift_block(folder: LiftFolder, number: int, progress: StageProgress, masks: str) -> LiftFolder:
    """The finished lift of a block. If another process lifts it, wait for that. ``masks``: see ``is_done``; they are
    those that the building has just read. Raises PlgsError, Cancelled."""
    path, request = folder.path / BLOCKS / str(number), request_of_block(folder.request, number)
    if not (path / "request.json").exists():
        try:
            LiftFolder.create(path, request)
        except PlgsError:
            if not (path / "request.json").exists():  # otherwise two engines made it at the same time
                raise
    lift = LiftFolder.open(path)
    differing = request.differences(lift.request)
    if differing:
        what = f"the block was lifted with different options: {', '.join(differing)}"
        raise PlgsError(what, path, "Delete this folder, then resume.")
    while lift.is_running or not is_done(lift, masks):
        _let_lift(lift, number, progress)
        masks = ""  # they may have changed during the lift
    return lift


def _let_lift(lift: LiftFolder, number: int, progress: StageProgress) -> None:
    """Start an engine for a block, or follow the one that is at work there, to its end. How that one ends does not
    matter, as its machine may crash: the block is checked again.
    """
    # Also a new block: before this engine begins, another may have begun it, or done it.
    command = engine_command(Path(sys.executable), lift.path, resume=True)
    is_running = lift.is_running
    follower = (
        TaskFollower.attach(lift.place, lift=lift)
        if is_running
        else TaskFollower.start(command, lift.place, kind=LIFT, lift=lift)
    )
    blocks, hundredths = lift.request.blocks, 0
    try:
        while follower.is_running:
            follower.poll()
            done = follower.progress
            share = done.step / max(done.steps, 1)
            within = (max(done.stage_index, 1) - 1 + min(share, 1.0)) / max(done.stage_count, 1)
            hundredths = max(hundredths, round(100 * within))
            progress(100 * (number - 1) + hundredths, 100 * blocks)
            time.sleep(LOOK_EVERY_S)
    except Cancelled:
        if not is_running:
            follower.cancel()
            while follower.is_running:
                follower.poll()
                time.sleep(LOOK_EVERY_S)
        raise
    finally:
        follower.close()
    error = follower.error
    if error is not None and error.code is not ErrorCode.BUSY and not is_running:
        raise PlgsError(f"block {number}: {error.what}", error.where, error.fix, code=error.code, option=error.option)
    if follower.state is TaskState.CANCELLED and not is_running:
        raise PlgsError(f"block {number} was cancelled", lift.path, "Resume the lift.")


def read_block(lift: LiftFolder, cell: Cell) -> LiftedBlock:
    """The content of a block's finished lift. Raises PlgsError."""
    points = read_arrays(lift.result_path / SEMANTIC_POINTS, SemanticPoints)
    _, instances = read_instances(lift.result_path / INSTANCES)
    return LiftedBlock(cell, read_model(lift), points, instances)
