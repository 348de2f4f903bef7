"""A whole experiment: around a pretended engine and, slowly, around the real one."""

import csv
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.job import EventReader, ExitCode, LiftFolder, LiftRequest
from engine.job.terminal import Interrupts
from engine.metrics.report import INPUT_MASKS
from research.baselines.voxel_vote import VOXEL_VOTE
from research.baselines.without_a_lift import VOXELS_ALONE, WITHOUT_A_LIFT
from research.command_line import main
from research.experiments.experiment import Experiment, SceneToLift
from research.experiments.run import run_experiment
from research.results import Figures, Result
from tests.raises_key import raises_key
from tests.research.experiments.made_up import ROWS
from tests.tiny_scene import write_tiny_scene

FAKE_ENGINE = Path(__file__).parents[2] / "job" / "fake_engine.py"

Behave = Callable[[str, str], None]
"""Sets what the engine does with the lift of a name (see fake_engine.py); "short" otherwise."""


@pytest.fixture
def behave(monkeypatch: pytest.MonkeyPatch, quick_python: Path) -> Behave:
    behaviours: dict[str, str] = {}

    def fake_command(python: Path, lift: Path, *, resume: bool, program: str) -> list[str | Path]:
        command: list[str | Path] = [quick_python, FAKE_ENGINE, behaviours.get(lift.name, "short"), lift]
        return [*command, "--resume"] if resume else command

    monkeypatch.setenv("PLGS_ENGINE_PYTHON", sys.executable)
    monkeypatch.setattr("engine.job.terminal.engine_command", fake_command)
    return behaviours.__setitem__


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    scenes = [
        SceneToLift(name, write_tiny_scene(tmp_path / "scenes" / name, frames=6), "z") for name in ("office", "kitchen")
    ]
    return Experiment(tuple(scenes), tmp_path / "out", ROWS, only=("ours",))


def run(experiment: Experiment) -> ExitCode:
    with Interrupts() as interrupts:
        return run_experiment(experiment, interrupts)


def runs_of(experiment: Experiment, lift: str) -> list[bool]:
    """Whether each run of the engine resumed an earlier one."""
    events = EventReader(experiment.folder / lift / "events.jsonl").poll()
    return [bool(event.data["resumed"]) for event in events if event.kind == "hello"]


def read_results(path: Path) -> list[Result]:
    entries = json.loads(path.read_text())["results"]
    return [Result(**{**entry, "figures": Figures(**entry["figures"])}) for entry in entries]


def measured(experiment: Experiment) -> list[tuple[str, str]]:
    return [(one.scene, one.row) for one in read_results(experiment.folder / "results.json")]


def test_every_scene_is_lifted_once(experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(experiment) is ExitCode.FINISHED
    text = capsys.readouterr().out
    assert "### office" in text and "### kitchen" in text
    report = (experiment.folder / "results.md").read_text()
    assert "| ours" in report and "elsewhere (cited)" in report and "elsewhere" not in text
    assert measured(experiment) == [("office", "ours"), ("kitchen", "ours")]
    first = read_results(experiment.folder / "results.json")
    assert run(experiment) is ExitCode.FINISHED
    assert runs_of(experiment, "office-preview") == runs_of(experiment, "kitchen-preview") == [False]
    assert read_results(experiment.folder / "results.json") == first


def test_an_experiment_lifts_its_rows_one_after_the_other(experiment: Experiment, behave: Behave) -> None:
    some = replace(experiment, scenes=experiment.scenes[:1], only=("ours", "parts", "input masks"), seeds=(0, 2))
    assert run(some) is ExitCode.FINISHED
    assert measured(some) == [
        *[("office", method) for method in WITHOUT_A_LIFT],
        *[("office", "ours")] * 2, *[("office", "theirs")] * 2, *[("office", "without depth")] * 2,
    ], "one row is another's lift, one needs files that the scene has not"  # fmt: skip
    requests = {path.parent.name: LiftRequest.read(path) for path in some.folder.glob("*/request.json")}
    assert requests["office-preview"].options == {} and requests["office-preview-seed2"].seed == 2
    assert requests["office-preview-theirs"].options == {"objects": "boxes"}
    assert requests["office-preview-without-depth-seed2"].options == {"weights.depth": 0.0}
    assert sorted(requests) == sorted(
        lift + seed
        for lift in ("office-preview", "office-preview-theirs", "office-preview-without-depth")
        for seed in ("", "-seed2")
    )


def test_tables_of_finished_rows_start_no_lift(experiment: Experiment, behave: Behave) -> None:
    assert run(replace(experiment, scenes=experiment.scenes[:1])) is ExitCode.FINISHED
    whole = replace(experiment, only=("ours", "parts"), only_finished=True)
    assert run(whole) is ExitCode.FINISHED
    assert measured(whole) == [("office", "ours")] and runs_of(whole, "office-preview") == [False]
    (whole.folder / "office-preview" / "result" / "metrics.json").write_text("{")
    assert run(whole) is ExitCode.BAD_INPUT
    (damaged,) = read_results(whole.folder / "results.json")
    assert "metrics.json" in damaged.failed and damaged.figures == Figures()
    assert runs_of(whole, "office-preview") == [False], "a damaged lift is reported, not lifted again"
    assert sorted(path.parent.name for path in whole.folder.glob("*/request.json")) == ["office-preview"]


def test_an_experiment_reads_scenes_as_the_options_say(experiment: Experiment, behave: Behave, tmp_path: Path) -> None:
    classes = tmp_path / "mine.toml"
    classes.write_text('[[class]]\nname = "cabinet"\ninto = "wall"\n')
    arguments = [str(experiment.scenes[0].folder), "-o", str(experiment.folder), "--only", "ours", "input masks"]
    reading = ["--format", "scannet", "--mask-format", "coco", "--classes"]
    assert main(["experiments", *arguments, *reading, str(classes)]) == 0
    request = LiftRequest.read(experiment.folder / "office-preview" / "request.json")
    assert (request.scene_format, request.mask_format, request.classes) == ("scannet", "coco", str(classes))
    with raises_key("other-options mask_format"):
        run(experiment)


def test_a_row_uses_depth_of_another(experiment: Experiment, behave: Behave, monkeypatch: pytest.MonkeyPatch) -> None:
    exported: list[tuple[Path, str, list[str]]] = []

    def export(lift: LiftFolder, kind: str, output: Path, frames: list[str]) -> None:
        exported.append((lift.path, kind, frames))
        output.mkdir()
        for frame in range(6):
            np.save(output / f"{frame:04d}.npy", np.full((48, 64), 2.0, np.float32))

    monkeypatch.setattr("engine.export.run.export", export)
    some = replace(experiment, scenes=experiment.scenes[:1], only=("depths",))
    for _ in range(2):
        assert run(some) is ExitCode.FINISHED
    assert measured(some) == [("office", "without depth"), ("office", "no sensor")]
    assert exported == [(some.folder / "office-preview-without-depth", "depth", ["all"])]
    request = LiftRequest.read(some.folder / "office-preview-no-sensor" / "request.json")
    assert request.depth == some.folder / "office-preview-no-sensor-maps"


def test_a_failed_lift_is_resumed(experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]) -> None:
    behave("office-preview", "exits")
    assert run(experiment) is ExitCode.INTERNAL_ERROR
    office, kitchen = read_results(experiment.folder / "results.json")
    assert office.failed and not kitchen.failed and kitchen.figures.seconds is not None
    printed = capsys.readouterr()
    assert "Failed: office: ours." in printed.err and f"failed: {office.failed}" in printed.out
    behave("office-preview", "short")
    assert run(experiment) is ExitCode.FINISHED
    assert runs_of(experiment, "office-preview") == [False, True]
    assert measured(experiment) == [("office", "ours"), ("kitchen", "ours")]


def test_an_experiment_reports_bad_input_before_any_lift(experiment: Experiment, behave: Behave) -> None:
    with raises_key("shared-path --masks"):
        run(replace(experiment, masks="predictions"))
    with raises_key("bad-value steps"):
        run(replace(experiment, steps=0))
    with raises_key("no-row"):
        run(replace(experiment, only=("hours",)))
    with raises_key("no-option weights.depth"):
        run(replace(experiment, sets=("weights.dept=0",)))
    assert not experiment.folder.exists()


def test_a_missing_scene_is_listed(experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]) -> None:
    missing = SceneToLift("cellar", experiment.folder / "cellar")
    page = experiment.folder / "results.md"
    three = replace(experiment, scenes=(missing, *experiment.scenes), only=("ours", "input masks"))
    assert run(three) is ExitCode.BAD_INPUT
    results = {(one.scene, one.row): one for one in read_results(three.folder / "results.json")}
    failed = {key for key, one in results.items() if one.failed}
    assert failed == {("cellar", "ours"), ("cellar", "input masks")} and ("kitchen", "ours") in results
    assert "cellar" in results["cellar", "ours"].failed
    assert "failed: " in page.read_text().split("### office")[0] and "failed: " in capsys.readouterr().out
    with (three.folder / "results.csv").open(newline="") as file:
        assert sum("cellar" in line["failed"] for line in csv.DictReader(file)) == 2


def test_an_experiment_finds_masks_by_path_patterns(experiment: Experiment, behave: Behave, tmp_path: Path) -> None:
    office, kitchen = experiment.scenes
    masks = tmp_path / "predictions" / "office"
    masks.mkdir(parents=True)
    for name in ("panoptic.json", "panoptic"):
        (office.folder / name).rename(masks / name)
    arguments = [str(scene.folder) for scene in experiment.scenes] + ["-o", str(experiment.folder)]
    arguments += ["--masks", f"{tmp_path}/predictions/{{scene}}", "--only", "ours", "input masks"]
    arguments += ["--frames", "4", "--fit", "--device", "cpu"]
    assert main(["experiments", *arguments]) == ExitCode.BAD_INPUT, "the kitchen has no predictions"
    results = {(one.scene, one.row): one for one in read_results(experiment.folder / "results.json")}
    assert {key for key, one in results.items() if one.failed} == {("kitchen", "ours"), ("kitchen", "input masks")}
    assert "predictions/kitchen" in Path(results["kitchen", "ours"].failed).as_posix()
    assert results["office", "input masks"].figures.pq is not None
    request = LiftRequest.read(experiment.folder / "office-preview" / "request.json")
    assert (request.masks, request.fit, request.device) == (masks, True, "cpu")
    assert request.chosen_preset.frames == 4
    by_depth = replace(experiment, scenes=(kitchen,), depth=f"{tmp_path}/depths/{{scene}}")
    assert run(by_depth) is ExitCode.BAD_INPUT
    (failed,) = [
        one for one in read_results(experiment.folder / "results.json") if one.scene == "kitchen" and one.row == "ours"
    ]
    assert "depths/kitchen" in Path(failed.failed).as_posix()


def test_an_experiment_refuses_a_strangers_folder_before_any_lift(experiment: Experiment, behave: Behave) -> None:
    foreign = experiment.folder / "kitchen-preview"
    foreign.mkdir(parents=True)
    (foreign / "notes.txt").touch()
    with raises_key("folder-used notes.txt"):
        run(experiment)
    (foreign / "notes.txt").unlink()
    foreign.rmdir()
    foreign.touch()
    with raises_key("in-the-way"):
        run(experiment)
    assert not (experiment.folder / "office-preview").exists()


def test_earlier_results_are_kept(experiment: Experiment, behave: Behave, capsys: pytest.CaptureFixture[str]) -> None:
    page = experiment.folder / "results.md"
    assert run(replace(experiment, only=("ours", "input masks"))) is ExitCode.FINISHED
    capsys.readouterr()
    assert run(replace(experiment, scenes=experiment.scenes[:1], only=("theirs",))) is ExitCode.FINISHED
    assert "| ours" not in capsys.readouterr().out, "what is asked for is shown"
    rows = [row for scene, row in measured(experiment) if scene == "office"]
    assert rows == ["ours", "theirs"]
    assert "| theirs" in page.read_text() and "| ours" in page.read_text()
    others = replace(experiment, scenes=experiment.scenes[:1], only=("without depth",), steps=7)
    assert run(others) is ExitCode.FINISHED
    rows = [row for scene, row in measured(others) if scene == "office"]
    assert rows == ["without depth"], "lifts by other options are none of these"


def test_an_experiment_runs_the_real_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_python: Path
) -> None:
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", str(quick_python))
    room, out = write_tiny_scene(tmp_path / "room", frames=6, noise=0.1), tmp_path / "out"
    arguments = [str(room), "--steps", "3", "--set", "warm_start=false", "-o", str(out)]
    arguments += ["--only", "ours", "3DGS", "input masks"]
    assert main(["experiments", *arguments]) == 0
    results = {result.row: result for result in read_results(out / "results.json")}
    assert set(results) == {"ours", "3DGS", *WITHOUT_A_LIFT}
    ours, masks = results["ours"], results[INPUT_MASKS]
    lacking = {name for name, value in ours.figures._asdict().items() if value is None}
    assert lacking <= {"id_changes", "peak_bytes"}, "one frame is held out; Windows does not report memory"
    assert (ours.steps, masks.figures.psnr) == (3, None) and results["3DGS"].figures.psnr is not None
    assert results[VOXEL_VOTE].figures.miou == results[VOXELS_ALONE].figures.miou
