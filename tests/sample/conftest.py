"""The sample's programs import each other as scripts do, from their own folder."""

from __future__ import annotations

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
def make(request: pytest.FixtureRequest) -> Make:
    """Runs the program that a test module names PROGRAM, in a process of its own."""

    def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, SAMPLE / request.module.PROGRAM, *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    return run


@pytest.fixture
def refused(make: Make) -> Refused:
    """Asserts that the program refuses its arguments in one line with these words."""

    def check(words: str, *arguments: str | Path) -> None:
        said = make(*arguments)
        assert said.returncode == 2 and said.stderr.startswith("error: ") and said.stderr.count("\n") == 1
        assert words in said.stderr

    return check
