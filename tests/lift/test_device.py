"""``--device``: what is missing is told before any work; the lift's own calls run on the back end for CUDA."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from engine.command_line.run_engine import run_engine
from engine.job import ExitCode, JobError, LiftFolder, LiftRequest
from engine.lift import device
from engine.lift.device import refuse_missing_device
from engine.model.label_voting import contributors
from engine.model.render import render_view
from engine.raster import cuda, interface
from tests.raster.plain_tile_lists import list_tiles_plainly
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, trainer_of, views_of


def test_without_a_cuda_device_a_lift_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    scene = write_tiny_scene(tmp_path / "scene", frames=4)
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, device="cuda"))
    assert run_engine(lift) is ExitCode.BAD_INPUT
    told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("error:")]
    assert told == [
        "error: torch finds no CUDA device here: --device cuda. Use a machine that has one with a build of torch for "
        "CUDA, or lift with --device cpu."
    ]
    assert '"stage"' not in lift.events_path.read_text(encoding="utf-8")


def test_without_gsplat_it_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(device, "what_is_missing", lambda: "gsplat is not installed; install it")
    with pytest.raises(JobError, match="gsplat is not installed; install it: --device cuda"):
        refuse_missing_device("cuda")
    refuse_missing_device("cpu")


def test_a_lift_trains_renders_and_votes_on_the_back_end_for_cuda(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With tensors on the CPU, and plain torch in the place of gsplat's two operators."""
    views, classes = views_of(tmp_path / "scene")
    preset = replace(TINY, label_every=1)
    ours, theirs = (trainer_of(views, classes, preset, tmp_path) for _ in range(2))
    losses = [[ours.step().loss for _ in range(4)]]  # a round of growth is after the third
    seen, drawn = contributors(ours.scene, views[0].camera, 3), render_view(ours.scene, views[0].camera)
    monkeypatch.setattr(interface, "_pick", lambda backend, means: "gsplat")
    monkeypatch.setattr(cuda, "list_by_gsplat", list_tiles_plainly)
    losses.append([theirs.step().loss for _ in range(4)])
    np.testing.assert_allclose(losses[1], losses[0], rtol=0.02)
    assert len(theirs.scene.anchors) == pytest.approx(len(ours.scene.anchors), rel=0.05)
    again, redrawn = contributors(ours.scene, views[0].camera, 3), render_view(ours.scene, views[0].camera)
    assert (again.gaussian == seen.gaussian).mean() > 0.99
    np.testing.assert_allclose(redrawn.image, drawn.image, atol=1e-3)
    np.testing.assert_allclose(redrawn.class_coverage, drawn.class_coverage, atol=1e-3)
