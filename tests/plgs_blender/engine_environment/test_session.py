"""What goes on with the engine in a Blender: followed by its timer or waited for by a script."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from package_index import PackageIndex
from plgs.engine.job import JobError
from plgs.engine.job.handshake import VERSION, EngineAnswer
from plgs.plgs_blender import engine_environment
from plgs.plgs_blender.engine_environment import EngineState, choices, session
from plgs.plgs_blender.engine_environment.progress import Wish
from plgs.plgs_blender.engine_environment.set_up import SetUp

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is chosen by XDG_CACHE_HOME")
Python = Callable[..., Path]


@pytest.fixture(autouse=True)
def own_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing is known, nothing was made, nothing is chosen; offline as Blender is by default."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("PLGS_ENGINE_PYTHON", raising=False)
    session.register()
    yield
    session.unregister()
    choices.choose(None)
    bpy.context.preferences.system.use_online_access = False


@pytest.fixture
def python(tmp_path: Path) -> Python:
    """Makes programs that answer as a Python with this engine does, or otherwise."""

    def make(name: str = "python", words: str = "", **packages: str | None) -> Path:
        wanted = {"torch": "2.0", "numba": "1.0"}
        answer = EngineAnswer(VERSION, "3.11.9", tmp_path / name, {**wanted, **packages}, wanted, 4, None)
        path = tmp_path / name
        path.write_text(f"#!/bin/sh\n{words or f'''echo '{answer.to_line().decode().strip()}' '''}\n")
        path.chmod(0o755)
        return path

    return make


def test_at_first_nothing_is_known_and_nothing_speaks_against_it() -> None:
    status = engine_environment.status()
    assert status.state is EngineState.UNKNOWN and status.is_usable


def test_the_chosen_python_is_asked_without_waiting(python: Python) -> None:
    chosen = python()  # written once: a program that is written anew while it starts may fail
    choices.choose(chosen)
    session.check()
    assert engine_environment.status().state is EngineState.CHECKING
    assert engine_environment.engine_python() == chosen
    session.wait()
    status = engine_environment.status()
    assert status.state is EngineState.READY and status.python == chosen
    assert status.message == f"Engine {VERSION}, Python 3.11.9, torch 2.0 (CPU), 4 cores" and not status.fix
    assert engine_environment.usable_python() == chosen


def test_a_window_goes_by_what_is_known(python: Python, monkeypatch: pytest.MonkeyPatch) -> None:
    """It does not wait for a second look: the engine itself says what it lacks when it was asked too soon."""
    monkeypatch.setattr(engine_environment, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
    choices.choose(python(torch=None))
    assert engine_environment.usable_python() == python(torch=None)
    session.check()
    session.wait()
    with pytest.raises(JobError, match="lacks torch") as refused:
        engine_environment.usable_python()
    assert "Set up engine" in refused.value.fix and engine_environment.engine_python() is None


def test_what_is_wrong_comes_with_what_mends_it(python: Python, monkeypatch: pytest.MonkeyPatch) -> None:
    for chosen, state, told, mend in (
        (python("a", numba=None), EngineState.MISSING, "lacks numba", "Set up engine"),
        (python("b", "exit 3"), EngineState.FAILED, "exit code 3", "Choose another Python"),
        (Path("/nowhere/python"), EngineState.FAILED, "/nowhere/python", "a Python"),
    ):
        choices.choose(chosen)
        session.check()
        session.wait()
        status = engine_environment.status()
        assert status.state is state and not status.is_usable and engine_environment.engine_python() is None
        assert told in status.message and mend in status.fix
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", str(python("c", torch=None)))
    session.check()
    session.wait()
    assert "PLGS_ENGINE_PYTHON" in engine_environment.status().fix


def test_other_versions_are_noted_but_may_work(python: Python) -> None:
    choices.choose(python(torch="3.0"))
    session.check()
    session.wait()
    status = engine_environment.status()
    assert status.state is EngineState.READY and "torch 3.0 instead of 2.0" in status.note


def test_where_there_is_no_python_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise JobError("no Python for the engine", "here", "Get one.")

    monkeypatch.setattr(session, "choose_python", none)
    session.check()
    status = engine_environment.status()
    assert status.state is EngineState.MISSING and "Set up engine" in status.fix


def test_nothing_is_set_up_offline() -> None:
    assert "Allow online access" in (session.why_no_set_up() or "")
    with pytest.raises(JobError, match="Preferences > System"):
        session.start_set_up(Wish())
    assert session.progress() is None and not session.log_path().exists()


@pytest.fixture
def online(code: Path, monkeypatch: pytest.MonkeyPatch, index: PackageIndex) -> Wish:
    """A wish that the index fulfils; sessions set the copy of the code up."""
    bpy.context.preferences.system.use_online_access = True
    monkeypatch.setattr(session, "SetUp", partial(SetUp, root=code))
    return Wish(Path(sys.executable), "cpu", index.url)


def test_a_script_sets_up_and_the_engine_answers(online: Wish, folder: Path) -> None:
    choices.choose(Path("/nowhere/python"))  # which is why somebody sets it up
    session.start_set_up(online)
    assert session.why_no_set_up() == "The engine is being set up already"
    told: list[str] = []
    session.wait(told.append)
    assert session.set_up_error() is None and session.progress() is None
    assert "3/6 Installing torch" in told and session.log_lines()
    status = engine_environment.status()
    assert status.state is EngineState.READY and status.python is not None
    assert status.python.is_relative_to(folder)

    (folder / "engine-mine").mkdir()  # no environment
    session.remove()
    assert not status.python.exists() and engine_environment.status().python != status.python
    session.wait()
    assert {path.name for path in folder.iterdir()} == {"engine-mine", "set-up.log", "set-up.lock"}


def test_an_error_stays_to_be_read(online: Wish, folder: Path) -> None:
    session.start_set_up(replace(online, base_python=Path("/nowhere/python")))
    session.wait()
    error = session.set_up_error()
    assert error is not None and "/nowhere/python cannot be run" in error.what
    assert any("/nowhere/python" in line for line in session.log_lines())


def test_switching_online_access_off_ends_it(online: Wish, folder: Path, index: PackageIndex) -> None:
    index.fault["torch"] = "stall"
    session.start_set_up(online)
    give_up = time.monotonic() + 30
    while not index.stalled.is_set():
        session.pump()
        assert time.monotonic() < give_up
        time.sleep(0.02)
    with pytest.raises(JobError, match="being set up"):
        session.remove()
    bpy.context.preferences.system.use_online_access = False
    session.pump()
    assert session.progress() is None
    assert "online access" in str(session.set_up_error())


def test_the_timer_asks_and_then_stops(python: Python, monkeypatch: pytest.MonkeyPatch) -> None:
    choices.choose(python())
    session.check()
    waits = [session.tick()]
    give_up = time.monotonic() + 10
    while waits[-1] is not None:
        assert time.monotonic() < give_up
        time.sleep(0.01)
        waits.append(session.tick())
    assert engine_environment.status().state is EngineState.READY


def test_switching_the_extension_off_ends_what_goes_on(python: Python, tmp_path: Path) -> None:
    pid = tmp_path / "pid"
    choices.choose(python("slow", f"echo $$ > {pid}.part; mv {pid}.part {pid}; exec sleep 60"))
    session.check()
    give_up = time.monotonic() + 10
    while not pid.exists():
        assert time.monotonic() < give_up
        time.sleep(0.01)
    session.unregister()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
    session.register()
