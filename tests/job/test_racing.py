"""Two processes race at one lift folder: one wins, the other says so in a line, and a resume finishes the lift."""

import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from engine.command_line.run_engine import run_engine
from engine.job import EventReader, ExitCode, LiftFolder, LiftRequest, verify
from engine.job.folder import FILES, FOLDERS
from tests.job.following import tiny_lift

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
RACER = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from engine.command_line.run_engine import run_engine
from engine.errors import PlgsError
from engine.job import EventReader, LiftFolder, LiftRequest
from tests.job.fake_engine import Pretence
from tests.job.following import tiny_lift
from tests.job.test_faults import bake

def lift(resume):
    return run_engine(LiftFolder.open(path), resume=resume, lift=Pretence("short, at once"))

path, orders = Path(sys.argv[2]), sys.argv[3:]
actions = {
    "create": lambda: LiftFolder.create(path, LiftRequest(scene=Path("/scene"))),
    "start": lambda: lift(False),
    "resume": lambda: lift(True),
    "cancel": lambda: LiftFolder.open(path).task_files.ask_to_cancel(),
    "discard": lambda: LiftFolder.open(path).discard(),
    "bake": lambda: bake(path, ("x", "y", "z")),
}
sys.stdin.readline()  # all at once
for order in orders:
    try:
        actions[order]()
    except (PlgsError, OSError) as error:
        print(f"refused: {order}: {error}")
"""


@pytest.mark.parametrize("seed", range(4))
def test_two_commands_that_race_for_a_lift_leave_it_resumable(root: Path, tmp_path: Path, seed: int) -> None:
    chance, path = random.Random(seed), tmp_path / "lift"
    racers = []
    for _ in range(2):
        orders = ["create", *chance.choices(["start", "resume", "cancel", "discard", "bake", "create"], k=6)]
        command = [sys.executable, "-c", RACER, root, path, *orders]
        racers.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE))
    for racer in racers:
        racer.stdin.write(b"go\n")
        racer.stdin.flush()
    for racer in racers:
        said, complained = (stream.decode() for stream in racer.communicate(timeout=120))
        assert racer.returncode == 0 and "Traceback" not in complained, complained
        assert all(line.startswith(("refused: ", "This lift is finished")) for line in said.splitlines()), said
    if not (path / "request.json").exists():  # removed, but for what the other made at that very moment
        assert not path.exists() or {each.name for each in path.iterdir()} <= {*FILES, *FOLDERS}
        shutil.rmtree(path, ignore_errors=True)
        LiftFolder.create(path, LiftRequest(scene=Path("/scene")))
    folder = LiftFolder.open(path)
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED
    verify(folder.result_path)
    numbers = [event.seq for event in EventReader(folder.events_path).poll()]
    assert numbers == sorted(set(numbers))
