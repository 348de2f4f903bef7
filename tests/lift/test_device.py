"""``--device``: what is missing is told before any work; the lift's own calls run on the back end for CUDA."""

import gc
import sys
from pathlib import Path

import pytest
import torch
from numba.core.dispatcher import Dispatcher

from engine.command_line.run_engine import run_engine
from engine.job import EventWriter, ExitCode, LiftFolder, LiftRequest, StopSignal, last_run
from engine.job.progress import StageReporter
from engine.job.report import read_metrics
from engine.lift import device, run, warm_up
from engine.lift.device import usable_device
from engine.lift.run import STAGES
from engine.model.render import render_bands
from engine.model.structured import StructuredScene
from engine.passes.baked_view import ShownInstances, bake_view
from engine.train.arithmetic import IN_TORCH, KERNELS
from engine.train.trainer import Trainer
from tests.raises_key import raises_key, worded
from tests.raster.gsplat_in_torch import use_a_stand_in
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, colour_error, lift_into, presets_as, trainer_of, views_of


def test_device_cuda_is_refused_on_a_machine_without_cuda(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    scene = write_tiny_scene(tmp_path / "scene", frames=4)
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, device="cuda"))
    assert run_engine(lift) is ExitCode.BAD_INPUT
    assert worded("no-cuda --device").search(capfd.readouterr().err)
    assert '"stage"' not in lift.events_path.read_text(encoding="utf-8")


@pytest.fixture
def stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StageReporter:
    """Of a computer with a GPU and torch for it."""
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    return StageReporter(EventWriter(tmp_path / "events.jsonl"), StopSignal(), STAGES)


def test_a_cpu_torch_is_told_from_a_missing_gpu(stages: StageReporter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: False)
    with raises_key("cpu-torch --device"):
        usable_device("cuda", stages)


def test_without_gsplat_the_error_says_how_to_get_it(stages: StageReporter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "what_is_missing", lambda: "gsplat is not installed; install it")
    with raises_key("gsplat-missing gsplat --device cuda"):
        usable_device("cuda", stages)
    usable_device("cpu", stages)


def test_a_broken_gsplat_is_refused(stages: StageReporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []

    def compile_and_fail(where: str) -> str:
        told.append((tmp_path / "events.jsonl").read_text(encoding="utf-8"))
        return f"nvcc failed for {where}"

    monkeypatch.setattr(device, "what_is_missing", lambda: None)
    monkeypatch.setattr(device, "what_fails", compile_and_fail)
    with raises_key("gsplat-fails --device") as error:
        usable_device("cuda", stages)
    assert sys.executable in error.value.fix
    assert "compiles once" in told[0], "before that begins, as it takes minutes"


@pytest.mark.parametrize(
    ("found", "why"),
    [(True, "--device cuda is experimental, never run by us on a GPU"), (False, "torch finds no CUDA device here")],
)
def test_device_auto_chooses_the_cpu_and_says_why(
    found: bool, why: str, stages: StageReporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: found)
    monkeypatch.setattr(device, "what_is_missing", lambda: None)
    monkeypatch.setattr(device, "what_fails", lambda where: None)
    if found:
        assert usable_device("cuda", stages) == "cuda"
    assert usable_device("auto", stages) == "cpu"
    told = [event.data["message"] for event in last_run(tmp_path / "events.jsonl") if event.kind == "warning"]
    assert told == [f"this lift runs on the CPU: {why}"]


def test_a_whole_lift_runs_on_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=6, size=(40, 30))
    with presets_as(preview=TINY):
        plain = lift_into(tmp_path / "plain", LiftRequest(scene=scene))
        use_a_stand_in(monkeypatch)
        moved: list[str] = []
        trained_on = Trainer.move_to

        def pretend(trainer: Trainer, where: str) -> None:
            moved.append(where)
            trained_on(trainer, "cpu")
            trainer.arithmetic = IN_TORCH if where == "cuda" else KERNELS

        monkeypatch.setattr(run, "usable_device", lambda wanted, stages: "cuda")
        monkeypatch.setattr(Trainer, "move_to", pretend)
        monkeypatch.setattr(StructuredScene, "on", lambda scene, where: moved.append(f"baked on {where}") or scene)
        device_lift = lift_into(tmp_path / "device", LiftRequest(scene=scene, device="cuda"))
    assert moved == ["cuda", "cpu", "baked on cuda"]
    ours, theirs = (
        [table["psnr"] for table in read_metrics(each)["tables"] if table["name"] == "lifted"]
        for each in (plain, device_lift)
    )
    assert ours and theirs == pytest.approx(ours, abs=0.5)


def compiled() -> dict[str, int]:
    """How many machine code versions each of the engine's kernels has in this process."""
    gc.unfreeze()  # what conftest.py has frozen
    kernels = [each for each in gc.get_objects() if issubclass(type(each), Dispatcher)]  # asks nothing of the others
    gc.freeze()
    ours = [kernel for kernel in kernels if kernel.__module__.startswith("engine.")]
    return {f"{kernel.__module__}.{kernel.__name__}": len(kernel.signatures) for kernel in ours}


def test_training_compiles_nothing_after_the_warm_up(tmp_path: Path) -> None:
    warm_up()
    before = compiled()
    assert len(before) > 10 and sum(before.values()) > 10
    views, classes = views_of(tmp_path / "scene")
    trainer = trainer_of(views, classes, TINY, tmp_path)
    while not trainer.finished:
        trainer.step()
    colour_error(views, trainer)
    for owned in (None, {1: 5}):
        camera = views[0].camera
        for most_bytes in (None, 1):  # whole, and in bands
            bands = render_bands(trainer.scene, camera, most_bytes=most_bytes)
            bake_view(bands, camera, classes, ShownInstances({}, owned))
    assert compiled() == before
