"""``python -m research``: its output and exit codes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from engine.presets.preset import PRESETS
from research.command_line import main
from tests.commands import exit_code, refuse_heavy_help


def code_of(*arguments: str | Path) -> int:
    return exit_code(main, *arguments)


@pytest.mark.parametrize("command", [[], ["experiments"], ["bench"]])
def test_help_imports_nothing_heavy(root: Path, command: list[str]) -> None:
    refuse_heavy_help(root, "research.command_line", command)


def test_research_runs_as_a_module(root: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "research", "experiments", "--list"],
        cwd=root, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert said.returncode == 0 and "    3DGS\n" in said.stdout


def test_wrong_arguments_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("experiments", "--seeds", "0,one") == 2
    assert "'0,one' is not a list of whole numbers such as 0,1,2" in capsys.readouterr().err


def test_ctrl_c_says_how_to_continue(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where pytest runs in the background
    try:
        monkeypatch.setattr("research.experiments.run.run_experiment", stopped)
        assert code_of("experiments", "SCENE") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.splitlines() == ["Stopped. The same command continues."]


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
