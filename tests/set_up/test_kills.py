"""A set-up is killed before any of its changes to files: the next one goes on to a whole environment."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
from pathlib import Path

import pytest

from engine.job.environment import is_complete
from tests.faults import Faults
from tests.killed_engine import Changes, Moment
from tests.set_up.test_faults import PACKAGES, environment_in, set_up_in

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="POSIX signals")


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


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_the_next_set_up_resumes(code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, counted = tmp_path / "cache", tmp_path / "count"
    faults, chance = Faults(folder, monkeypatch), random.Random(0)
    assert killed(folder, code, faults, 0, counted) == 0
    changes = int(counted.read_text())
    assert changes > 20
    for moment in range(1, changes + 1):
        shutil.rmtree(folder)
        for at in (moment, chance.randint(1, changes)):  # the set-up that goes on is killed, too, or gets to its end
            assert killed(folder, code, faults, at, counted) in (-signal.SIGKILL, 0), at
        assert set_up_in(folder, code, faults) is None, moment
        made = environment_in(folder)
        assert made is not None and is_complete(made) and len(list((made / "lib").iterdir())) >= PACKAGES
