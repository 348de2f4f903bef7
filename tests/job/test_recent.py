"""The list of recent lifts: found again, in order, whatever became of them or of the list."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from engine.job import EventWriter, LiftState, StopSignal
from engine.job.environment import notes_folder
from engine.job.recent import MOST, recent_lifts, remember_lift
from tests.job.following import new_lift, tiny_lift


def test_recent_lifts_are_listed_newest_first_without_repeats(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert recent_lifts(cache) == []
    one, two = new_lift(tmp_path, "one"), new_lift(tmp_path, "two")
    for folder in (one, two, one):
        remember_lift(folder.path, cache)
    lifts = recent_lifts(cache)
    assert [lift.folder for lift in lifts] == [one, two]
    assert lifts[0].touched >= lifts[1].touched > time.time() - 60
    assert lifts[0].state is LiftState.NOT_STARTED


def test_the_state_of_recent_lifts_is_known(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    finished, running, gone, broken = (new_lift(tmp_path, name) for name in ("finished", "running", "gone", "broken"))
    for folder in (finished, running, gone, broken):
        remember_lift(folder.path, cache)
    tiny_lift(finished, EventWriter(finished.events_path), StopSignal(finished.cancel_path), resume=False)
    shutil.rmtree(gone.path)
    (broken.path / "request.json").write_text("{")
    with running.lock():
        found = {lift.folder.path.name: lift.state for lift in recent_lifts(cache)}
    assert found == {"running": LiftState.RUNNING, "finished": LiftState.FINISHED}


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"format": 2}',
        '{"format": 1, "lifts": [1, {"path": 2}, {}]}',
        '{"format": 1, "lifts": [{"path": "/", "touched": 1%s}, {"path": "/", "touched": NaN}]}' % ("0" * 400),
        "[" * 100_000,
        "\0",
    ],
    ids=range(7),
)
def test_a_broken_list_of_recent_lifts_is_started_again(tmp_path: Path, content: str) -> None:
    (tmp_path / "recent_lifts.json").write_text(content)
    assert recent_lifts(tmp_path) == []
    folder = new_lift(tmp_path)
    remember_lift(folder.path, tmp_path)
    assert [lift.folder for lift in recent_lifts(tmp_path)] == [folder]


def test_a_damaged_entry_of_the_recent_lifts_loses_no_other(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    remember_lift(folder.path, tmp_path)
    path = tmp_path / "recent_lifts.json"
    content = json.loads(path.read_text())
    content["lifts"] += [1, {"path": 2, "touched": 3}, {"path": "/", "touched": 1, "size": 4}]
    path.write_text(json.dumps(content))
    assert [lift.folder for lift in recent_lifts(tmp_path)] == [folder]


def test_the_list_of_recent_lifts_has_a_maximum_length(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    for number in range(MOST + 3):
        remember_lift(new_lift(tmp_path, f"lift {number}").path, cache)
    lifts = recent_lifts(cache)
    assert [lift.folder.path.name for lift in lifts] == [f"lift {number}" for number in range(MOST + 2, 2, -1)]


def test_engines_that_end_together_lose_no_recent_lift(tmp_path: Path, root: Path) -> None:
    """On a slow disk, too."""
    code = (
        "import os, sys, time; from pathlib import Path; from engine.job.recent import remember_lift\n"
        "os.fsync = lambda descriptor: time.sleep(0.05)\n"
        "for path in sys.argv[2:]: remember_lift(Path(path), Path(sys.argv[1]))"
    )
    paths = [[new_lift(tmp_path, f"{each} {number}").path for number in range(8)] for each in range(3)]
    processes = [subprocess.Popen([sys.executable, "-c", code, tmp_path, *each], cwd=root) for each in paths]
    assert [process.wait(timeout=120) for process in processes] == [0, 0, 0]
    assert {lift.folder.path for lift in recent_lifts(tmp_path)} == {path for each in paths for path in each}


def test_the_cache_folder_follows_environment_variables(tmp_path: Path) -> None:
    assert notes_folder({"PLGS_CACHE_DIR": str(tmp_path)}) == tmp_path
    if sys.platform == "linux":
        assert notes_folder({"XDG_CACHE_HOME": str(tmp_path)}) == tmp_path / "plgs"
        for none in ({}, {"XDG_CACHE_HOME": ""}, {"XDG_CACHE_HOME": "a relative one"}):
            assert notes_folder(none) == Path.home() / ".cache" / "plgs"
