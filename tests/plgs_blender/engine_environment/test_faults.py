"""Whatever call of the file system fails while the engine is set up: it says so, and the next set-up goes on."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import pytest
from plgs.engine.job import JobError
from plgs.engine.job.environment import is_complete, python_in
from plgs.engine.job.handshake import EngineAnswer
from plgs.plgs_blender.engine_environment.base_python import PROBE
from plgs.plgs_blender.engine_environment.progress import Outcome, Wish
from plgs.plgs_blender.engine_environment.set_up import SetUp

from tests.job.faults import Faults, every_fault

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="descriptors are looked up as Linux has them")
PACKAGES = 3
"""Calls of pip, each of which leaves a file."""


class PretendedSetUp(SetUp):
    """Programs do at once what they are for, and never meet the faults: those are this process's."""

    faults: Faults

    def _run(self, command: Sequence[str | Path], **options: Any) -> Generator[None, None, tuple[str, int]]:
        yield
        with self.faults.asleep():
            if PROBE in command:
                return json.dumps([sys.version_info[:2], sys.executable, []]), 0
            if "venv" in command:
                python = python_in(Path(command[-1]))
                python.parent.mkdir(parents=True)
                python.symlink_to(sys.executable)
            if "pip" in command:
                lib = Path(command[0]).parents[1] / "lib"
                lib.mkdir(exist_ok=True)
                (lib / str(len(list(lib.iterdir())))).touch()
        return "", 0

    def _ask(self, python: Path) -> Generator[None, None, EngineAnswer]:
        yield
        return EngineAnswer("0.1.0", "3.11.0", python, {}, {}, 1, None)


def set_up_in(folder: Path, root: Path, faults: Faults) -> Outcome:
    set_up = PretendedSetUp(Wish(Path(sys.executable)), root, folder)
    set_up.faults = faults
    for _ in range(200):
        set_up.poll()
        if set_up.outcome is not None:
            return set_up.outcome
    pytest.fail("it never ends")


def environment_in(folder: Path) -> Path | None:
    return next(folder.glob("engine-*"), None)


@pytest.mark.parametrize("thoroughly", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["in turn", "all"])
def test_the_next_set_up_goes_on(code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thoroughly: bool) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(1 << 40, 0, 1 << 40))
    folder = tmp_path / "cache"
    faults, refused = Faults(folder, monkeypatch), 0
    for at, error, for_good in every_fault(faults, thoroughly):
        print(f"call {at}, error {error}")  # for a test that fails
        with faults.failing(at, error, for_good):
            outcome = set_up_in(folder, code, faults)
        made = environment_in(folder)
        if made is not None and is_complete(made):
            assert len(list((made / "lib").iterdir())) >= PACKAGES
        if outcome.error is not None:
            refused += 1
            assert isinstance(outcome.error, JobError) and "\n" not in str(outcome.error) and outcome.error.fix
        assert set_up_in(folder, code, faults).python is not None
        made = environment_in(folder)
        assert made is not None and is_complete(made) and len(list((made / "lib").iterdir())) >= PACKAGES
        shutil.rmtree(folder)
    assert refused > 10
