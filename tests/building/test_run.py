"""A building is lifted block by block; what is there already is taken; it stops and goes on."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from engine import scene_of_lift
from engine.building import run
from engine.command_line.main import main
from engine.errors import Cancelled, PlgsError
from engine.job import CheckpointStore, EventWriter, LiftFolder, LiftRequest, LiftState, StopSignal, last_run, verify
from engine.job.manifest import add_files
from engine.lift import bake_frames, run_lift
from engine.metrics.unshown import Refused, Unshown
from engine.records import to_json
from engine.result_files import INSTANCES, SEMANTIC_POINTS, SemanticPoints, read_arrays, read_instances, write_arrays
from engine.scene import open_scene
from engine.scene.blocks import cells_of
from engine.scene_of_lift import EARLIER, is_done
from tests.job.following import command_after_another
from tests.tiny_scene import CABINET_ID, CHAIR_ID, FLOOR_ID, write_tiny_scene
from tests.train.tiny_lift import short_warm_start
from tests.waiting import wait_until

OPTIONS = {"steps": 4, "steps_a_view": 0.0, "voxel_size": 0.2}


def lift(folder: LiftFolder, *, resume: bool = False) -> None:
    if resume:
        folder.prepare_run()
    events = EventWriter(folder.events_path)
    try:
        work = run_lift if folder.request.block else run.run_building
        with short_warm_start():
            work(folder, events, StopSignal(folder.cancel_path), resume=resume)
    finally:
        events.close()


@pytest.fixture(autouse=True)
def again_as_before() -> Iterator[None]:
    yield
    torch.set_deterministic_debug_mode("default")


@pytest.fixture
def building(tmp_path: Path, quick_python: Path, monkeypatch: pytest.MonkeyPatch) -> LiftFolder:
    monkeypatch.setattr(run, "sys", SimpleNamespace(executable=quick_python))
    scene = write_tiny_scene(tmp_path / "room", frames=8, noise=0.1)
    return LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, options=OPTIONS, blocks=2, bake="none"))


def test_a_building_in_two_blocks(building: LiftFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = LiftFolder.create(building.path / "blocks" / "2", run.request_of_block(building.request, 2))
    lift(elsewhere)
    made = elsewhere.manifest_path.stat().st_mtime_ns
    one = read_instances(elsewhere.result_path / INSTANCES)[1][0]
    assert main(["correct", str(elsewhere.path), "rename", str(one.id), "Seat"]) == 0

    with monkeypatch.context() as patch:
        patch.setattr("engine.building.run.LOOK_EVERY_S", 0.0)
        patch.setattr("engine.building.run._let_lift", stop_at_once)
        with pytest.raises(Cancelled):
            lift(building)
    trial = refuse_in(elsewhere)
    lift(building, resume=True)

    metrics = json.loads((building.result_path / "metrics.json").read_text())
    told = [one for one in metrics["masks_as_judges"]["not_shown"] if one["refused"]]
    assert told == [json.loads(json.dumps(to_json(trial)))]
    verify(building.result_path)
    warned = [str(event.data["message"]) for event in last_run(building.events_path) if event.kind == "warning"]
    assert any("corrections of block 2 are not taken over" in line for line in warned)
    assert elsewhere.manifest_path.stat().st_mtime_ns == made
    points = read_arrays(building.result_path / SEMANTIC_POINTS, SemanticPoints)
    _, instances = read_instances(building.result_path / INSTANCES)
    assert {CHAIR_ID, CABINET_ID} <= {one.class_id for one in instances}
    assert set(points.instance_id[points.instance_id > 0]) <= {one.id for one in instances}
    events = EventWriter(building.events_path)
    bake_frames(building, ["0001"], events, StopSignal(building.cancel_path))
    events.close()
    assert (building.passes_path / "0001.exr").is_file() and building.is_whole()

    # As a later version would lift the block by hand: with points of its own.
    assert is_done(building)
    own = read_arrays(elsewhere.result_path / SEMANTIC_POINTS, SemanticPoints)
    write_arrays(elsewhere.result_path / SEMANTIC_POINTS, replace(own, confidence=own.confidence / 2))
    add_files(elsewhere.result_path, [elsewhere.result_path / SEMANTIC_POINTS])
    assert not is_done(building)
    digests = Mock(side_effect=scene_of_lift.digest_of_masks)
    with monkeypatch.context() as patch:
        patch.setattr(scene_of_lift, "digest_of_masks", digests)
        lift(building, resume=True)
    assert digests.call_count == 1, "not once more for each block"
    again = read_arrays(building.result_path / SEMANTIC_POINTS, SemanticPoints)
    assert again.confidence.sum() < points.confidence.sum() and is_done(building)
    assert (building.path / EARLIER / "1" / "passes" / "0001.exr").is_file() and not building.passes_path.exists()

    elsewhere.manifest_path.write_text("{")
    assert not is_done(building), "a damaged block is lifted again"
    lift(building, resume=True)
    assert is_done(building) and elsewhere.is_whole()


def refuse_in(block: LiftFolder) -> Unshown:
    """As if a cabinet had been tried on the floor before a block was trained, twice: in its cell, and out of it."""
    points = read_arrays(block.result_path / SEMANTIC_POINTS, SemanticPoints)
    floor = points.xyz[points.class_id == FLOOR_ID]
    cell = cells_of(open_scene(block.request.scene), 2, lambda *_: None)[0][1]
    store = CheckpointStore(block.path, "preparation")
    kept, found = store.latest(), []
    assert kept is not None
    for inside in (floor[cell.contains(floor)], floor[~cell.contains(floor)]):
        near = inside[np.argsort(np.linalg.norm(inside - inside[0], axis=1))[:9]]
        x, y, z = near.mean(axis=0).round(3).tolist()
        about = CABINET_ID, "cabinet", False, 3, 3, "0001", 7, 90, 0.01, "floor", (x, y, z), "it trails"
        found.append(Refused(Unshown(*about), tuple(map(tuple, near.tolist()))))
    arrays = (kept.path / "arrays.npz").read_bytes()
    state = {**kept.state, "refused": [to_json(one) for one in found]}
    store.save(state, lambda folder: (folder / "arrays.npz").write_bytes(arrays))
    return found[0].finding


def stop_at_once(block: LiftFolder, number: int, progress: object) -> None:
    """In place of the engine that lifts a block: somebody cancels the building."""
    assert number == 1 and block.request.block == 1 and not block.is_running
    raise Cancelled


def test_a_cancel_ends_the_engine_of_the_block(building: LiftFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    block = building.path / "blocks" / "1"

    def sleep(seconds: float) -> None:
        time.sleep(seconds)
        if (block / "events.jsonl").exists():  # its engine has begun
            building.cancel_path.touch()

    monkeypatch.setattr(run, "time", SimpleNamespace(sleep=sleep))
    with pytest.raises(Cancelled):
        lift(building)
    lifted = LiftFolder.open(block)
    # On a busy machine its process is killed: the fork that stands in for the engine then ends a moment later.
    wait_until(lambda: not lifted.is_running)
    assert lifted.state() not in (LiftState.FINISHED, LiftState.NOT_STARTED)


def test_a_block_lifted_with_other_options_is_reported(building: LiftFolder) -> None:
    other = replace(run.request_of_block(building.request, 1), seed=5)
    LiftFolder.create(building.path / "blocks" / "1", other)
    with pytest.raises(PlgsError, match="lifted with different options: seed"):
        lift(building)


def test_a_block_that_another_lifts_before_this_engine_begins(
    building: LiftFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "engine_command", command_after_another)
    block = LiftFolder.create(building.path / "blocks" / "1", run.request_of_block(building.request, 1))
    run._let_lift(block, 1, lambda done, total: None)
    assert block.state() is LiftState.FINISHED


def test_labels_that_are_not_voted_cannot_be_joined(building: LiftFolder) -> None:
    request = replace(building.request, options={**OPTIONS, "labels": "decoders"})
    with pytest.raises(PlgsError, match="joined by the views' votes"):
        lift(replace(building, request=request))


class StartedAnEngine(Exception):
    """In place of an engine of one's own."""


def test_after_another_machine_crashed_the_block_is_lifted_here(
    building: LiftFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = PlgsError("the engine ended without a message", building.path, "Resume the lift.")
    ended = SimpleNamespace(is_running=False, error=silent, state=None, close=lambda: None)
    runs = iter([True, True])  # while its lease is looked at, and followed

    def started(*_: object, **__: object) -> None:
        raise StartedAnEngine

    monkeypatch.setattr(LiftFolder, "is_running", property(lambda _: next(runs, False)))
    monkeypatch.setattr(run.TaskFollower, "attach", lambda *_, **__: ended)
    monkeypatch.setattr(run.TaskFollower, "start", started)
    with pytest.raises(StartedAnEngine):
        run.lift_block(building, 1, lambda *_: None, "")
