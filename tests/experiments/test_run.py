"""A whole experiment: around an engine that pretends, and, slowly, around the real one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from engine.command_line.main import main
from engine.experiments import Experiment, SceneToLift, read_results, run_experiment
from engine.job import EventReader, ExitCode, JobError
from engine.job.terminal import Interrupts
from engine.metrics import LIFTED, MACHINE_MASKS, VOXEL_VOTE
from engine.scene import SceneError
from tests.experiments.made_up import OFFICE
from tests.tiny_scene import write_tiny_scene

FAKE_ENGINE = Path(__file__).parents[1] / "job" / "fake_engine.py"

Behave = Callable[[str, str], None]
"""Sets what the engine does with the lift of a name (see fake_engine.py); "short" otherwise."""


@pytest.fixture
def behave(monkeypatch: pytest.MonkeyPatch) -> Behave:
    behaviours: dict[str, str] = {}

    def fake_command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
        command: list[str | Path] = [sys.executable, FAKE_ENGINE, behaviours.get(lift.name, "short"), lift]
        return [*command, "--resume"] if resume else command

    monkeypatch.setenv("PLGS_ENGINE_PYTHON", sys.executable)
    monkeypatch.setattr("engine.job.session.engine_command", fake_command)
    return behaviours.__setitem__


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    scenes = [
        SceneToLift(name, write_tiny_scene(tmp_path / "scenes" / name, frames=6), "z") for name in ("office", "kitchen")
    ]
    return Experiment(tuple(scenes), tmp_path / "out")


def run(experiment: Experiment) -> ExitCode:
    with Interrupts() as interrupts:
        return run_experiment(experiment, interrupts)


def runs_of(experiment: Experiment, lift: str) -> list[bool]:
    """Whether each run of the engine resumed an earlier one."""
    events = EventReader(experiment.folder / lift / "events.jsonl").poll()
    return [bool(event.data["resumed"]) for event in events if event.kind == "hello"]


def test_every_scene_is_lifted_once(
    experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(experiment) is ExitCode.FINISHED
    table = capsys.readouterr().out
    assert table.count("\n") == 4 and "office" in table and "kitchen" in table
    assert (experiment.folder / "results.md").read_text() == table
    results = read_results(experiment.folder / "results.json")
    assert [result.scene for result in results] == ["office", "kitchen"]
    seconds = [result.rows[LIFTED].seconds for result in results]
    assert run(experiment) is ExitCode.FINISHED
    assert runs_of(experiment, "office-preview") == runs_of(experiment, "kitchen-preview") == [False]
    assert [result.rows[LIFTED].seconds for result in read_results(experiment.folder / "results.json")] == seconds


def test_a_lift_that_failed_is_resumed_and_keeps_nobody_waiting(
    experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]
) -> None:
    behave("office-preview", "exits")
    assert run(experiment) is ExitCode.INTERNAL_ERROR
    assert [result.scene for result in read_results(experiment.folder / "results.json")] == ["kitchen"]
    assert "Not lifted: office." in capsys.readouterr().err
    behave("office-preview", "short")
    assert run(experiment) is ExitCode.FINISHED
    assert runs_of(experiment, "office-preview") == [False, True]
    assert [result.scene for result in read_results(experiment.folder / "results.json")] == ["office", "kitchen"]


def test_bad_input_is_told_before_any_lift(experiment: Experiment, behave: Behave) -> None:
    missing = SceneToLift("none", experiment.folder / "none")
    with pytest.raises(SceneError, match="none"):
        run(replace(experiment, scenes=(*experiment.scenes, missing)))
    with pytest.raises(JobError, match="steps"):
        run(replace(experiment, steps=0))
    with pytest.raises(JobError, match="none of these scenes"):
        run(replace(experiment, earlier=(replace(OFFICE, scene="cellar"),)))
    assert not experiment.folder.exists()


def test_a_foreign_folder_is_told_before_any_lift(experiment: Experiment, behave: Behave) -> None:
    foreign = experiment.folder / "kitchen-preview"
    foreign.mkdir(parents=True)
    (foreign / "notes.txt").touch()
    with pytest.raises(JobError, match=r"notes\.txt"):
        run(experiment)
    (foreign / "notes.txt").unlink()
    foreign.rmdir()
    foreign.touch()
    with pytest.raises(JobError, match="in the way"):
        run(experiment)
    assert not (experiment.folder / "office-preview").exists()


def test_figures_that_cannot_be_read_are_made_anew_as_the_error_says(experiment: Experiment, behave: Behave) -> None:
    assert run(experiment) is ExitCode.FINISHED
    figures = experiment.folder / "kitchen-preview" / "result" / "metrics.json"
    figures.write_bytes(b"x" * figures.stat().st_size)
    with pytest.raises(JobError, match="Delete it"):
        run(experiment)
    figures.unlink()
    assert run(experiment) is ExitCode.FINISHED
    assert runs_of(experiment, "kitchen-preview") == [False, True]


def test_a_finished_lift_with_other_settings_is_not_taken(experiment: Experiment, behave: Behave) -> None:
    with_steps = replace(experiment, steps=7)
    assert run(with_steps) is ExitCode.FINISHED
    with pytest.raises(JobError, match="another steps"):
        run(experiment)
    with pytest.raises(JobError, match="another seed"):
        run(replace(with_steps, seed=2))


def test_a_comparison(experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(replace(experiment, earlier=(OFFICE,))) is ExitCode.FINISHED
    rows = capsys.readouterr().out.splitlines()
    assert "80.0 -> -" in rows[2] and "->" not in rows[3]


@pytest.mark.slow
def test_the_real_engine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", sys.executable)
    rich = write_tiny_scene(tmp_path / "rich", frames=6, noise=0.1)
    poor = write_tiny_scene(tmp_path / "poor", frames=6, ground_truth=False, up="-y")
    out = tmp_path / "out"
    assert main(["experiments", str(rich), f"{poor}:up=-y", "--steps", "3", "-o", str(out)]) == 0
    first, second = read_results(out / "results.json")
    assert list(first.rows) == [MACHINE_MASKS, VOXEL_VOTE, LIFTED] and list(second.rows) == [LIFTED]
    assert all(figure is not None for figure in first.rows[LIFTED])
    assert second.rows[LIFTED].miou is None and second.rows[LIFTED].depth_error_m is not None
    assert (first.steps, first.rows[MACHINE_MASKS].psnr) == (3, None)
    capsys.readouterr()
    arguments = [str(rich), "--steps", "3", "-o", str(out), "--against", str(out / "results.json")]
    assert main(["experiments", *arguments]) == 0
    assert capsys.readouterr().out.count(" -> ") == 9
