"""Followed tasks: started, told apart by their keys, cancelled, and ended with Blender; and how Blender itself ends."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import bpy
import pytest
from plgs.engine.errors import PlgsError
from plgs.engine.job.follower import TaskFollower
from plgs.engine.job.process import EngineProcess
from plgs.engine.job.task import TaskFiles
from plgs.plgs_blender import registry
from plgs.plgs_blender.registry import Task

from plgs_blender.lifecycle import drop_session_folder
from tests.raises_key import raises_key
from tests.waiting import wait_until

ANSWERING = """
import json, sys
events = [{"event": "stage", "name": "s", "index": 1, "count": 2, "label": "Half"},
          {"event": "answer", "answer": {"number": 7}}, {"event": "done", "state": "finished"}]
with open(sys.argv[1], "w") as file:
    for seq, event in enumerate(events, start=1):
        print(json.dumps({"seq": seq, "time": 0.0, **event}), file=file)
"""
SLEEPING = "import time; time.sleep(600)"


class Pretended(Task):
    """It keeps the answer, or raises what it is told."""

    kind, label = "pretended", "Pretending"
    taken: Any = None
    raises: Exception | None = None

    def done(self, scene: Any) -> None:
        self.taken = (scene, self.answer)
        if self.raises is not None:
            raise self.raises


def begin(program: str) -> Pretended:
    files = TaskFiles.temporary()
    process = EngineProcess([sys.executable, "-c", program, files.events])
    return registry.follow(Pretended(TaskFollower(files, process, kind=Pretended.kind)))


def test_the_answer_of_a_finished_task_is_handled_once() -> None:
    task, told = begin(ANSWERING), list[str]()
    assert registry.running(Pretended) == [task] and registry.latest(Pretended) is task
    with raises_key("at-work Pretending"):
        registry.refuse_second(Pretended)
    registry.wait_for(task, "scene", told.append)
    assert task.taken == ("scene", {"number": 7}) and task.has_finished and told == ["1/2 Half"]
    task.taken = None
    registry.wait_for(task, "scene")
    assert registry.poll_all("scene") == [] and task.taken is None
    assert registry.running(Task) == [] and registry.latest(Pretended) is task
    assert task.follower.files.folder is not None and not task.follower.files.folder.exists()


@pytest.mark.parametrize("error", [PlgsError("made-up", "is gone", "here", "Again."), OSError("the disk is gone")])
def test_a_task_answer_that_cannot_be_used_gives_an_error(error: Exception) -> None:
    task = begin(ANSWERING)
    task.raises = error
    registry.wait_for(task, None)
    assert not task.has_finished and "is gone" in str(task.error)


def test_a_cancelled_task_gives_no_error() -> None:
    task = begin(SLEEPING)
    task.cancel()
    registry.wait_for(task, None)
    assert task.was_cancelled and task.error is None and task.taken == (None, None)


def test_a_new_task_cancels_the_one_it_replaces() -> None:
    first = begin(SLEEPING)
    second = begin(SLEEPING)
    assert registry.running(Pretended) == [second] and first.follower.poll() is True and not first.is_running


def test_the_timer_polls_a_task_until_it_ends() -> None:
    task = begin(ANSWERING)
    wait_until(lambda: registry.tick() is None)
    assert task.taken == (bpy.context.scene, {"number": 7})


def test_a_failing_task_stops_no_other_task(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    task = begin(ANSWERING)
    task.raises = ZeroDivisionError("a defect")
    wait_until(lambda: registry.tick() is None)
    assert "ZeroDivisionError: a defect" in capfd.readouterr().err


def test_a_task_whose_program_cannot_be_run_is_reported(tmp_path: Path) -> None:
    with raises_key("not-runnable"):
        registry.start_engine("inspect", tmp_path / "no python")


LEFT_OVER = """
import ctypes, sys, bpy
ctypes.pythonapi.Py_IncRef(ctypes.py_object(bpy))
from plgs_blender.lifecycle import end_process
print(bpy.app.tempdir)
end_process(3)
"""


def test_blender_exits_although_a_task_is_still_referenced(root: Path) -> None:
    said = subprocess.run([sys.executable, "-c", LEFT_OVER], cwd=root, capture_output=True, text=True, timeout=60)
    assert said.returncode == 3, said.stderr
    folder = Path(said.stdout.splitlines()[-1])
    assert folder.is_absolute() and not folder.exists()


def test_closing_blender_deletes_only_its_own_temporary_folder(tmp_path: Path) -> None:
    session, shared = tmp_path / "blender_a1b2", tmp_path / "all"
    for folder in (session, shared):
        folder.mkdir()
        (folder / "file").touch()
        drop_session_folder(folder)
    assert not session.exists() and (shared / "file").exists()
