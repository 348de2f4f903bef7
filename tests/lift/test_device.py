"""``--device``: what is missing is told before any work; the lift's own calls run on the back end for CUDA."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numba.core.dispatcher import Dispatcher

from engine.command_line.run_engine import run_engine
from engine.job import EventWriter, ExitCode, LiftFolder, LiftRequest, StopSignal
from engine.lift import device, warm_up
from engine.lift.device import refuse_missing_device
from engine.lift.run import STAGES
from engine.model.render import render_bands, render_view
from engine.passes.baked_view import ShownInstances, bake_view
from engine.raster import interface
from engine.train.progress import StageReporter
from tests.raises_key import raises_key
from tests.raster.gsplat_in_torch import use_a_stand_in
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, colour_error, trainer_of, views_of


def test_without_a_cuda_device_a_lift_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    scene = write_tiny_scene(tmp_path / "scene", frames=4)
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, device="cuda"))
    assert run_engine(lift) is ExitCode.BAD_INPUT
    told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("error:")]
    assert told == [
        "error: torch finds no CUDA device here: --device cuda. Use a machine with a CUDA device and its driver, or "
        "lift with --device cpu."
    ]
    assert '"stage"' not in lift.events_path.read_text(encoding="utf-8")


@pytest.fixture
def stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StageReporter:
    """Of a computer with a GPU and torch for it."""
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    return StageReporter(EventWriter(tmp_path / "events.jsonl"), StopSignal(), STAGES)


def test_a_torch_for_cpus_is_told_from_a_computer_without_a_gpu(
    stages: StageReporter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: False)
    with raises_key("cpu-torch --device"):
        refuse_missing_device("cuda", stages)


def test_without_gsplat_the_error_says_how_to_get_it(stages: StageReporter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "what_is_missing", lambda: "gsplat is not installed; install it")
    with raises_key("gsplat-missing gsplat --device cuda"):
        refuse_missing_device("cuda", stages)
    refuse_missing_device("cpu", stages)


def test_a_gsplat_that_cannot_draw_is_found_before_any_work(
    stages: StageReporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []

    def compile_and_fail(where: str) -> str:
        told.append((tmp_path / "events.jsonl").read_text(encoding="utf-8"))
        return f"nvcc failed for {where}"

    monkeypatch.setattr(device, "what_is_missing", lambda: None)
    monkeypatch.setattr(device, "what_fails", compile_and_fail)
    with raises_key("gsplat-fails --device") as error:
        refuse_missing_device("cuda", stages)
    assert sys.executable in error.value.fix
    assert "compiles once" in told[0], "before that begins, as it takes minutes"


def test_a_lift_trains_and_renders_on_the_back_end_for_cuda(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tensors on the CPU, and a stand-in in the place of gsplat's call."""
    views, classes = views_of(tmp_path / "scene", size=(40, 30))
    preset = replace(TINY, label_every=1)
    ours, theirs = (trainer_of(views, classes, preset, tmp_path) for _ in range(2))
    losses = [[ours.step().loss for _ in range(4)]]  # a round of growth is after the third
    drawn = render_view(ours.scene, views[0].camera)
    use_a_stand_in(monkeypatch)
    monkeypatch.setattr(interface, "_pick", lambda backend, means: "gsplat")
    losses.append([theirs.step().loss for _ in range(4)])
    np.testing.assert_allclose(losses[1], losses[0], rtol=0.02)
    assert len(theirs.scene.anchors) == pytest.approx(len(ours.scene.anchors), rel=0.05)
    redrawn = render_view(ours.scene, views[0].camera)
    np.testing.assert_allclose(redrawn.image, drawn.image, atol=1e-3)
    np.testing.assert_allclose(redrawn.class_coverage, drawn.class_coverage, atol=1e-3)


def compiled() -> dict[str, int]:
    """How many machine code versions each of the engine's kernels has in this process."""
    kernels = [each for each in gc.get_objects() if issubclass(type(each), Dispatcher)]  # asks nothing of the others
    ours = [kernel for kernel in kernels if kernel.__module__.startswith("engine.")]
    return {f"{kernel.__module__}.{kernel.__name__}": len(kernel.signatures) for kernel in ours}


def test_nothing_is_left_to_compile(tmp_path: Path) -> None:
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
