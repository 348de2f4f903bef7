"""Baking more frames of a finished lift: the very bytes of a lift that bakes them, and never a broken result."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from engine.command_line.run_engine import run_bake
from engine.job import (
    Cancelled,
    EventWriter,
    ExitCode,
    JobError,
    LiftFolder,
    LiftRequest,
    LiftState,
    StopSignal,
    verify,
)
from engine.lift import bake_frames, bake_more, run_lift
from engine.lift.baking import FrameBaker
from engine.train.presets import PRESETS
from tests.lift.test_lift import files_of
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, LiftFolder]]:
    """The same lift with its held-out frame baked, and with all."""
    root = tmp_path_factory.mktemp("bake")
    scene = write_tiny_scene(root / "scene", frames=6, noise=0.1)
    preview = PRESETS["preview"]
    PRESETS["preview"] = TINY
    folders = {bake: LiftFolder.create(root / bake, LiftRequest(scene=scene, bake=bake)) for bake in ("test", "all")}  # type: ignore[arg-type]
    try:
        for folder in folders.values():
            events = EventWriter(folder.events_path)
            run_lift(folder, events, StopSignal(folder.cancel_path), resume=False)
            events.close()
        yield folders
    finally:
        PRESETS["preview"] = preview
        torch.use_deterministic_algorithms(False)


@pytest.fixture
def lift(finished: dict[str, LiftFolder], tmp_path: Path) -> LiftFolder:
    return LiftFolder.open(shutil.copytree(finished["test"].path, tmp_path / "lift"))


def bake(folder: LiftFolder, *frames: str) -> None:
    events = EventWriter(folder.events_path)
    try:
        bake_frames(folder, frames, events, StopSignal(folder.cancel_path))
    finally:
        events.close()


def test_the_bytes_of_a_lift_that_bakes_all(finished: dict[str, LiftFolder], lift: LiftFolder) -> None:
    before = json.loads(lift.manifest_path.read_text())
    bake(lift, "0002", "test")
    assert {path.stem for path in lift.passes_path.iterdir()} == {"0002", "0004"}
    times = {path: path.stat().st_mtime_ns for path in lift.result_path.rglob("*.*") if path != lift.manifest_path}
    bake(lift, "all")
    assert files_of(lift) == files_of(finished["all"])
    assert [file.path for file in verify(lift.result_path).files] == [
        file.path for file in verify(finished["all"].result_path).files
    ]
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())  # what was there was left alone
    after = json.loads(lift.manifest_path.read_text())
    assert {key: value for key, value in after.items() if key != "files"} == {
        key: value for key, value in before.items() if key != "files"
    }


def test_as_a_run_of_the_engine(lift: LiftFolder, capfd: pytest.CaptureFixture[str]) -> None:
    lift.ask_to_cancel()  # an old one
    seq = len(lift.events_path.read_bytes().splitlines())
    assert run_bake(lift, ["0000"]) is ExitCode.FINISHED
    told = [json.loads(line) for line in lift.events_path.read_bytes().splitlines()[seq:]]
    assert [each["event"] for each in told if each["event"] != "progress"] == [
        "hello", "stage", "stage", "artifact", "preview", "done"
    ]  # fmt: skip
    assert told[0]["task"] == "bake" and told[-1]["state"] == "finished"
    assert [each["step"] for each in told if each["event"] == "progress"] == [1]
    assert lift.state() is LiftState.FINISHED
    assert run_bake(lift, ["no such frame"]) is ExitCode.BAD_INPUT
    assert "no frame no such frame" in capfd.readouterr().err
    assert lift.state() is LiftState.FINISHED and lift.last_exit_code() == ExitCode.BAD_INPUT


def test_only_a_finished_lift_can_be_baked(lift: LiftFolder) -> None:
    with lift.lock(), pytest.raises(JobError, match="another engine"):
        run_bake(lift, ["all"])
    lift.manifest_path.unlink()
    with pytest.raises(JobError, match="not finished"):
        run_bake(lift, ["all"])


@pytest.mark.parametrize("failure", [Cancelled("asked to"), OSError(28, "No space left on device")])
def test_the_result_is_whole_whenever_it_ends(
    lift: LiftFolder, failure: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    render, rendered = FrameBaker.render, []

    def render_three(self: FrameBaker, frame: object) -> object:
        verify(lift.result_path)
        rendered.append(frame)
        if len(rendered) == 3:
            raise failure
        return render(self, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(FrameBaker, "render", render_three)
    with pytest.raises(type(failure)):
        bake(lift, "all")
    names = {file.path.stem for file in verify(lift.result_path).files if file.path.suffix == ".exr"}
    assert names == {"0000", "0001", "0004"} and lift.state() is LiftState.FINISHED


def test_a_kill_loses_little(lift: LiftFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bake_more, "KEEP_EVERY_S", -1.0)
    listed = []
    monkeypatch.setattr(bake_more, "add_files", lambda result, paths: listed.append({path.stem for path in paths}))
    bake(lift, "0000", "0001")
    assert [stems & {"0000", "0001"} for stems in listed] == [{"0000"}, {"0001"}]


def test_a_model_that_cannot_be_read_is_told_in_one_line(lift: LiftFolder) -> None:
    model = lift.result_path / "model.safetensors"
    whole = model.read_bytes()
    with safe_open(model, "pt") as file:
        facts = json.loads(file.metadata()["plgs"])
    save_file(load_file(model), model, metadata={"plgs": json.dumps(facts | {"format": 1})})
    with pytest.raises(JobError, match="model format 1 is not known"):
        bake(lift, "0002")
    model.write_bytes(whole[:100])
    with pytest.raises(JobError, match="the model cannot be read"):
        bake(lift, "0002")
    model.write_bytes(whole)
    manifest = json.loads(lift.manifest_path.read_text())
    del manifest["settings"]["one_class_an_object"]
    lift.manifest_path.write_text(json.dumps(manifest))
    with pytest.raises(JobError, match="one class"):
        bake(lift, "0002")
