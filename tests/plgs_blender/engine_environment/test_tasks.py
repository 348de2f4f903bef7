"""What this Blender knows of the engine: a Python is asked, the engine is set up, and both end with the extension."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from plgs.engine.errors import PlgsError
from plgs.engine.job.follower import TaskFollower
from plgs.engine.job.handshake import TOO_OLD, VERSION
from plgs.engine.job.process import EngineProcess
from plgs.engine.job.task import TaskFiles
from plgs.plgs_blender import engine_environment, registry
from plgs.plgs_blender.engine_environment import EngineState, choices, tasks
from plgs.plgs_blender.engine_environment.choices import SetUpChoice
from plgs.plgs_blender.engine_environment.tasks import EngineStatus
from pretended_python import pretended_python

from tests.raises_key import raises_key
from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is chosen by XDG_CACHE_HOME")
Python = Callable[..., Path]


@pytest.fixture(autouse=True)
def nothing_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing is known, nothing was made, nothing is chosen; offline as Blender is by default."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("PLGS_ENGINE_PYTHON", raising=False)
    tasks.register()
    yield
    tasks.unregister()
    choices.choose(None)
    bpy.context.preferences.system.use_online_access = False


@pytest.fixture
def python(tmp_path: Path) -> Python:
    """Makes pretended Pythons. Each is written once: a program that is rewritten while it starts may fail."""

    def make(name: str = "python", instead: str = "", **others: str | None) -> Path:
        return pretended_python(tmp_path / name, instead, **others)  # type: ignore[arg-type]

    return make


def answer_of(chosen: Path | None) -> EngineStatus:
    """What is known once the chosen Python was asked."""
    choices.choose(chosen)
    wait_for(tasks.check())
    return engine_environment.status()


def wait_for(task: registry.Task | None) -> None:
    if task is not None:
        registry.wait_for(task, bpy.context.scene)


def test_the_chosen_python_is_checked_in_the_background(python: Python) -> None:
    chosen = python()
    choices.choose(chosen)
    check = tasks.check()
    assert engine_environment.status().state is EngineState.CHECKING
    assert engine_environment.engine_python() == chosen
    wait_for(check)
    status = engine_environment.status()
    assert status.state is EngineState.READY and status.python == chosen
    assert status.message == f"Engine {VERSION}, Python 3.11.9, torch 2.0 (CPU), 4 cores" and not status.fix
    assert engine_environment.usable_python() == chosen


def test_the_window_does_not_wait_for_a_second_engine_check(python: Python, monkeypatch: pytest.MonkeyPatch) -> None:
    """It does not wait for a second look: the engine itself says what it lacks when it was asked too soon."""
    monkeypatch.setattr(engine_environment, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
    lacking = python(torch=None)
    choices.choose(lacking)
    assert engine_environment.usable_python() == lacking
    answer_of(lacking)
    with raises_key("no-engine lacks torch") as refused:
        engine_environment.usable_python()
    assert "Set Up Engine" in refused.value.fix and engine_environment.engine_python() is None
    assert "lacks torch" in (engine_environment.why_no_engine() or "")


def test_a_program_that_is_no_python_is_named(python: Python, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
    executable_picture = tmp_path / "run.png"
    executable_picture.write_bytes(picture.read_bytes())
    executable_picture.chmod(0o755)
    for number, (chosen, told, mend) in enumerate((
        (Path("/nowhere/python"), "/nowhere/python", "another Python"),
        (picture, "picture.png", "another Python"),
        (executable_picture, "run.png", "another Python"),
        (tmp_path, str(tmp_path), "another Python"),
        ("echo hello", "not as a Python", "Choose another Python"),
        ("echo No module named engine >&2; exit 1", "No module named", "Choose another Python"),
        (f"echo 'error: {TOO_OLD}, this is 3.9' >&2; exit 1", "3.9", "newer Python"),
        ("kill -SEGV $$", "does not run", "Choose another Python"),
        ("head -c 50000000 /dev/zero; exit 1", "does not run", "Choose another Python"),
    )):  # fmt: skip
        status = answer_of(python(f"python {number}", chosen) if isinstance(chosen, str) else chosen)
        assert status.state is EngineState.FAILED and not status.is_usable, (chosen, status)
        assert told in status.message and mend in status.fix and len(status.message) < 1000, (chosen, status)
        assert engine_environment.engine_python() is None
    status = answer_of(python("other", version="99.0"))
    assert status.state is EngineState.FAILED and "99.0" in status.message and "Restart" in status.fix
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", str(python("lacking", torch=None)))
    assert "PLGS_ENGINE_PYTHON" in answer_of(None).fix


def test_a_python_that_hangs_in_check_is_ended(python: Python, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pid = tmp_path / "pid"
    choices.choose(python("hanging", f"echo $$ > {pid}.part; mv {pid}.part {pid}; exec sleep 600"))
    task = tasks.check()
    wait_until(pid.exists, pid)
    monkeypatch.setattr(tasks, "PATIENCE_S", 0.0)
    wait_for(task)
    status = engine_environment.status()
    assert status.state is EngineState.FAILED and "did not answer" in status.message
    assert not Path(f"/proc/{int(pid.read_text())}").exists()


def test_an_engine_with_other_package_versions_is_used_with_a_note(python: Python) -> None:
    status = answer_of(python(torch="3.0"))
    assert status.state is EngineState.READY and "torch 3.0 instead of 2.0" in status.note


def test_without_a_python_the_engine_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise PlgsError("made-up", "no Python for the engine", "here", "Get one.")

    monkeypatch.setattr(tasks, "choose_python", none)
    assert tasks.check() is None
    status = engine_environment.status()
    assert status.state is EngineState.MISSING and "Set Up Engine" in status.fix


def test_the_set_up_is_refused_without_online_access() -> None:
    assert "Allow online access" in (tasks.why_no_set_up() or "")
    with raises_key("set-up-refused"):
        tasks.set_up(SetUpChoice())
    assert tasks.running_set_up() is None and not tasks.log_path().exists()


def test_passwords_are_not_passed_as_command_line_arguments() -> None:
    choice = SetUpChoice(Path("/base"), "cuda", "https://me:secret@index")
    assert choice.arguments() == ["--torch", "cuda", "--base-python", Path("/base")]
    assert choice.variables() == {"PLGS_INDEX_URL": "https://me:secret@index"} and SetUpChoice().variables() == {}


@pytest.fixture
def online() -> None:
    bpy.context.preferences.system.use_online_access = True


def pretend(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Let set-ups run a program instead of the engine."""
    ask = tasks.start_engine

    def start_engine(kind: str, python: Path, *arguments: str | Path, **others: object) -> TaskFollower:
        if kind != "set-up":
            return ask(kind, python, *arguments)
        return TaskFollower(TaskFiles.temporary(), EngineProcess([sys.executable, "-c", program]), kind=kind)

    monkeypatch.setattr(tasks, "start_engine", start_engine)


def test_a_set_up_is_followed_by_an_engine_check(online: None, python: Python, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "")
    choices.choose(python())  # which is why somebody sets it up
    set_up = tasks.set_up(SetUpChoice())
    assert tasks.why_no_set_up() == "The engine is already being set up"
    wait_for(set_up)
    assert set_up.has_finished and choices.chosen_python() is None
    assert engine_environment.status().state is EngineState.CHECKING


def test_switching_online_access_off_ends_a_set_up(online: None, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "import time; time.sleep(600)")
    set_up = tasks.set_up(SetUpChoice())
    with raises_key("being-set-up"):
        tasks.remove()
    bpy.context.preferences.system.use_online_access = False
    wait_for(set_up)
    assert tasks.running_set_up() is None and set_up.error.key == "offline"


def test_switching_the_extension_off_ends_running_tasks(python: Python, tmp_path: Path) -> None:
    pid = tmp_path / "pid"
    choices.choose(python("slow", f"echo $$ > {pid}.part; mv {pid}.part {pid}; exec sleep 600"))
    tasks.check()
    wait_until(pid.exists, pid)
    tasks.unregister()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
    tasks.register()
