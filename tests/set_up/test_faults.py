"""Whatever call of the file system fails while the engine is set up, or whenever it is killed: the next one goes on."""

import os
import random
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from engine.errors import PlgsError
from engine.job import EventWriter, StopSignal
from engine.job.environment import is_complete, python_in
from engine.job.handshake import EngineAnswer
from engine.set_up import SetUp, SetUpRequest
from tests.faults import Faults, every_fault
from tests.killed_engine import Changes, Moment

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="descriptors are looked up as Linux has them")
PACKAGES = 2
"""Calls of `uv pip`, each of which leaves a file."""


class PretendedSetUp(SetUp):
    """Programs do at once what they are for, and never meet the faults: those are this process's."""

    faults: Faults

    def _get_uv(self, tools: Path) -> Path:
        return Path("uv")

    def _run(self, command: Sequence[str | Path], *variables: Any, **options: Any) -> tuple[str, int]:
        with self.faults.asleep():
            if "find" in command:
                return "3.11.9", 0
            if "venv" in command:
                python = python_in(Path(command[-1]))
                python.parent.mkdir(parents=True)
                python.symlink_to(sys.executable)
            if "pip" in command:
                lib = Path(command[command.index("--python") + 1]).parents[1] / "lib"
                lib.mkdir(exist_ok=True)
                (lib / str(len(list(lib.iterdir())))).touch()
        return "", 0

    def _ask(self, python: Path) -> EngineAnswer:
        return EngineAnswer("0.1.0", "3.11.0", python, {}, {}, 1, None, {})


def set_up_in(folder: Path, root: Path, faults: Faults) -> PlgsError | None:
    """Its error; None when it made an environment."""
    events = EventWriter(folder.with_name("events.jsonl"))
    set_up = PretendedSetUp(SetUpRequest(Path(sys.executable)), events, StopSignal(), root, folder)
    set_up.faults = faults
    try:
        set_up.run()
        return None
    except PlgsError as error:
        return error
    finally:
        events.close()


def environment_in(folder: Path) -> Path | None:
    return next(folder.glob("engine-*"), None)


@pytest.mark.parametrize("thoroughly", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["in turn", "all"])
def test_a_failed_set_up_goes_on(code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thoroughly: bool) -> None:
    folder = tmp_path / "cache"
    faults, refused = Faults(folder, monkeypatch), 0
    for at, error, for_good in every_fault(faults, thoroughly):
        print(f"call {at}, error {error}")  # for a test that fails
        with faults.failing(at, error, for_good):
            refusal = set_up_in(folder, code, faults)
        made = environment_in(folder)
        if made is not None and is_complete(made):
            assert len(list((made / "lib").iterdir())) >= PACKAGES
        if refusal is not None:
            refused += 1
            assert "\n" not in str(refusal) and refusal.fix
        assert set_up_in(folder, code, faults) is None
        made = environment_in(folder)
        assert made is not None and is_complete(made) and len(list((made / "lib").iterdir())) >= PACKAGES
        shutil.rmtree(folder)
    assert refused > 10


def killed(folder: Path, root: Path, faults: Faults, at: int, counted: Path) -> int:
    """The exit code of a forked process that sets up and is killed at its change number ``at``; 0: never."""
    child = os.fork()
    if child == 0:
        code = 99
        try:
            changes = Changes(Moment(0, at) if at else None)
            changes.begin()
            code = 0 if set_up_in(folder, root, faults) is None else 1
            counted.write_text(str(changes.made[0]))
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.parametrize("thoroughly", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["some", "all"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_killed_set_up_goes_on(code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thoroughly: bool) -> None:
    folder, counted = tmp_path / "cache", tmp_path / "count"
    faults, chance = Faults(folder, monkeypatch), random.Random(0)
    assert killed(folder, code, faults, 0, counted) == 0
    changes = int(counted.read_text())
    assert changes > 20
    for moment in range(1, changes + 1) if thoroughly else chance.sample(range(1, changes + 1), 4):
        shutil.rmtree(folder)
        for at in (moment, chance.randint(1, changes)):  # the set-up that goes on is killed, too, or gets to its end
            assert killed(folder, code, faults, at, counted) in (-signal.SIGKILL, 0), at
        assert set_up_in(folder, code, faults) is None, moment
        made = environment_in(folder)
        assert made is not None and is_complete(made) and len(list((made / "lib").iterdir())) >= PACKAGES
