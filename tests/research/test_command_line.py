"""``python -m research``: its output and exit codes, and its smaller programs."""

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engine.errors import Cancelled
from engine.job import LiftFolder, LiftRequest
from engine.presets.preset import PRESETS
from engine.train.trainer import StepReport, Trainer
from research import reliability as r
from research.bench_step import profile_lift, typical
from research.command_line import main
from tests.commands import exit_code, refuse_heavy_help
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as, views_of


def code_of(*arguments: str | Path) -> int:
    return exit_code(main, *arguments)


@pytest.mark.parametrize("command", [[], ["experiments"], ["bench"]])
def test_research_help_imports_no_large_package(root: Path, command: list[str]) -> None:
    refuse_heavy_help(root, "research.command_line", command)


def test_research_runs_as_a_module(root: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "research", "experiments", "--list"],
        cwd=root, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert said.returncode == 0 and "    3DGS\n" in said.stdout


def test_research_refuses_wrong_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("experiments", "--seeds", "0,one") == 2
    assert "'0,one' is not a list of whole numbers such as 0,1,2" in capsys.readouterr().err


def test_ctrl_c_says_what_to_do_next(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where pytest runs in the background
    try:
        monkeypatch.setattr("research.experiments.run.run_experiment", stopped)
        assert code_of("experiments", "SCENE") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.splitlines() == ["Stopped. Give the same command again to continue."]


def test_bench_refuses_an_unwritable_file_before_measuring(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[str] = []
    monkeypatch.setattr("research.bench_step.bench_step", lambda preset: measured.append(preset) or {"ms": 1})
    for file in (tmp_path / "missing" / "figures.json", tmp_path):
        assert code_of("bench", "step", "--json", file) == 2
        captured = capsys.readouterr()
        assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
        assert str(tmp_path) in captured.err and not captured.out
    assert main(["bench", "step"]) == main(["bench", "step", "--json", str(tmp_path / "figures.json")]) == 0
    assert measured == [None, None] and json.loads((tmp_path / "figures.json").read_text()) == {"ms": 1}
    assert code_of("bench", "step", "--set", "voxel_size=0.04") == 2
    assert main(["bench", "step", "--preset", "paper", "--set", "voxel_size=0.04"]) == 0
    assert measured[2] == replace(PRESETS["paper"], voxel_size=0.04)


WITHOUT_GROWTH = replace(TINY, steps=1000)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    views, classes = views_of(tmp_path_factory.mktemp("step") / "scene")
    folder = tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder))
        measured = profile_lift(views, classes, WITHOUT_GROWTH, steps=6)
    assert not list(folder.glob("tmp*"))  # torch keeps a folder of its own there
    return measured


def test_bench_step_measures_every_part_of_a_training_step(profile: dict[str, Any]) -> None:
    facts = json.loads(json.dumps(profile))
    assert set(facts["parts_ms"]) == {
        "decode, forward", "decode, backward", "rasterise, forward", "rasterise, backward", "SSIM, L1, volume",
        "label losses", "further losses", "losses, backward", "growth statistics", "optimiser", "the rest",
    }  # fmt: skip
    assert all(milliseconds > 0 for milliseconds in facts["parts_ms"].values())
    assert all(facts[name] > 0 for name in ("core_ms", "draw_ms", "decide_ms", "gaussians"))
    assert 0 < facts["visible_anchors"] <= facts["anchors"]
    assert facts["step_ms"] == pytest.approx(sum(facts["parts_ms"].values()))


def test_bench_step_leaves_out_a_disturbed_step() -> None:
    steps = [{"one": 1.0 + k, "two": 2.0} for k in range(7)] + [{"one": 500.0, "two": 2.0}]
    parts = typical(steps)
    assert parts == pytest.approx({"one": 4500.0, "two": 2000.0})
    with pytest.raises(ValueError, match="no step"):
        typical([])


def test_the_expected_error_is_the_gap_between_the_curve_and_the_diagonal() -> None:
    probability, right = np.array([0.95] * 4 + [0.55] * 4), np.array([1, 1, 1, 0, 1, 1, 0, 0])
    curve = r.reliability(probability, right)
    assert np.allclose(curve[:, [5, 9]].T, [[4, 0.55, 0.5], [4, 0.95, 0.75]]) and curve.sum() == 8 + 1.5 + 1.25
    assert r.error(curve) == pytest.approx((0.2 + 0.05) / 2)
    assert r.error(r.reliability(probability[:0], right[:0])) == 0


def test_research_reliability_writes_its_table_and_diagram(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.array([[1.0] * 4, [0.75] * 4, [1, 1, 1, 0]], np.float32)
    monkeypatch.setattr(r, "pixels_of", lambda lift: pixels)
    pytest.importorskip("matplotlib")
    lines = list(r.reliability_table([tmp_path / "a", tmp_path / "b"], tmp_path / "curve.png"))
    assert lines[2:] == [f"| {name} | 75.0 % | 0.250 | 0.000 |" for name in ("a", "b", "all together")]
    assert (tmp_path / "curve.png").stat().st_size > 1000


def test_an_unfinished_lift_is_scored_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, stepped = write_tiny_scene(tmp_path / "scene", frames=10, noise=0.1), Trainer.step

    def step(trainer: Trainer, check: Callable[[], object]) -> StepReport:
        if trainer.step_number == 5:
            raise Cancelled("asked to")
        return stepped(trainer, check)

    with presets_as(preview=TINY):
        with monkeypatch.context() as stopping, pytest.raises(Cancelled):
            stopping.setattr(Trainer, "step", step)
            lift_into(tmp_path / "lift", LiftRequest(scene=scene))
        assert code_of("unfinished", tmp_path / "lift") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "after step 5:" and any(line.split()[:2] == ["lifted", "strict"] for line in lines)
    newest = LiftFolder.open(tmp_path / "lift").checkpoints.latest()
    assert newest is not None and newest.state["step"] == 5
    assert {path.name for path in tmp_path.iterdir()} == {"scene", "lift"}
