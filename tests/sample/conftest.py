"""The sample's programs import each other as scripts do, from their own folder."""

from __future__ import annotations

import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

SAMPLE = Path(__file__).resolve().parents[2] / "sample"
sys.path.append(str(SAMPLE))

Make = Callable[..., subprocess.CompletedProcess[str]]
Refused = Callable[..., None]


@pytest.fixture
def make(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Make:
    """Runs the program that a test module names PROGRAM."""

    def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        program = str(SAMPLE / request.module.PROGRAM)
        monkeypatch.setattr(sys, "argv", [program, *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(program, run_name="__main__")
        said = capsys.readouterr()
        return subprocess.CompletedProcess(sys.argv, int(ended.value.code or 0), said.out, said.err)

    return run


@pytest.fixture
def refused(make: Make) -> Refused:
    """Asserts that the program refuses its arguments in one line with these words."""

    def check(words: str, *arguments: str | Path) -> None:
        said = make(*arguments)
        assert said.returncode == 2 and said.stderr.startswith("error: ") and said.stderr.count("\n") == 1
        assert words in said.stderr

    return check
