"""run_plgs.py from outside: arguments, exit codes, Ctrl-C, and what is left behind."""

import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import run_plgs
from engine.job import LiftFolder, LiftState
from engine.job.events import last_run
from tests.commands import exit_code
from tests.raises_key import raises_key, worded
from tests.tiny_scene import write_tiny_scene
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")

Run = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def run(root: Path) -> Iterator[Run]:
    """Start run_plgs.py with a fake engine."""
    started: list[subprocess.Popen[str]] = []

    def start(behaviour: str, *arguments: str | Path) -> subprocess.Popen[str]:
        script = root / "tests" / "job" / "run_plgs_with_fake_engine.py"
        command = [sys.executable, script, behaviour, *arguments]
        started.append(subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=env()))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def env() -> dict[str, str]:
    """Whatever environment lies beside the code: these tests run the engine with the Python that runs them."""
    return os.environ | {"PLGS_ENGINE_PYTHON": sys.executable}


def run_script(
    root: Path, *arguments: str | Path, engine: Path = Path(sys.executable)
) -> subprocess.CompletedProcess[str]:
    """The real one. ``engine``: the engine's Python."""
    command = [sys.executable, root / "run_plgs.py", *arguments]
    variables = os.environ | {"PLGS_ENGINE_PYTHON": str(engine)}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=variables)


def wait_for(process: subprocess.Popen[str], ready: Callable[[], bool]) -> None:
    wait_until(lambda: ready() or process.poll() is not None)
    assert ready(), process.communicate()


def has_begun(out: Path) -> Callable[[], bool]:
    """Five steps are done: from here on the deaf engine is deaf."""
    events = out / "events.jsonl"
    return lambda: events.exists() and b'"step": 5' in events.read_bytes()


def test_resuming_a_finished_lift_only_repairs_the_blend(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = run("short", tmp_path / "scene", "-o", out, "--seed", "4")
    first.communicate(timeout=PATIENCE_S)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    again = run("broken", tmp_path / "scene", "-o", out, "--resume")
    assert "finished already" in again.communicate(timeout=PATIENCE_S)[1]
    assert again.returncode == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == before
    (out / "lift.blend").unlink()
    mending = run("broken", tmp_path / "scene", "-o", out, "--resume", "--seed", "4")
    mending.communicate(timeout=PATIENCE_S)
    assert mending.returncode == 0 and (out / "lift.blend").exists()
    (out / "lift.blend").write_bytes(b"BLENDER before the corrections")
    later = (out / "lift.blend").stat().st_mtime + 10
    (out / "corrections.json").touch()
    os.utime(out / "corrections.json", (later, later))
    run("broken", tmp_path / "scene", "-o", out, "--resume").communicate(timeout=PATIENCE_S)
    assert (out / "lift.blend").read_bytes() == b"BLENDER of out"
    other = run("broken", tmp_path / "scene", "-o", out, "--resume", "--seed", "5")
    assert "a different seed" in other.communicate(timeout=PATIENCE_S)[1]
    assert other.returncode == 2


@pytest.mark.parametrize(
    ("behaviour", "number", "code"),
    [("patient", signal.SIGINT, 130), ("holds the lock", signal.SIGINT, 130), ("patient", signal.SIGTERM, 143)],
)
def test_a_signal_ends_the_engine(run: Run, tmp_path: Path, behaviour: str, number: signal.Signals, code: int) -> None:
    out = tmp_path / "out"
    process = run(behaviour, tmp_path / "scene", "-o", out)
    wait_for(process, has_begun(out))
    process.send_signal(number)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code
    assert "--resume" in stderr
    lift = LiftFolder.open(out)
    assert not lift.is_running and lift.state() in (LiftState.CANCELLED, LiftState.INTERRUPTED)


def test_ctrl_c_while_the_blend_is_built_is_handled(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = run("short, slow save", tmp_path / "scene", "-o", out)
    wait_for(process, (out / "saving").exists)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert not (out / "lift.blend").exists()


def test_resuming_a_running_lift_leaves_it_alone(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = run("patient", tmp_path / "scene", "-o", out)
    wait_for(first, has_begun(out))
    engine = next(event.data["pid"] for event in last_run(out / "events.jsonl"))
    second = run("patient", tmp_path / "scene", "-o", out, "--resume")
    told = second.communicate(timeout=PATIENCE_S)[1]
    assert worded("at-work").search(told) and second.returncode == 75
    assert f"(process {engine} on {platform.node()}, since 2" in told and "'cancel'" in told
    third = run("patient", tmp_path / "scene", "-o", out, "--resume")
    assert third.stderr is not None and any("looks for a lift to resume" in line for line in third.stderr)
    third.send_signal(signal.SIGINT)
    third.communicate(timeout=PATIENCE_S)
    assert not (out / "cancel").exists() and first.poll() is None


@pytest.mark.parametrize(("behaviour", "code"), [("bad input", 2), ("segfault", 1)])
def test_run_plgs_gives_one_line_errors_and_exit_codes(run: Run, tmp_path: Path, behaviour: str, code: int) -> None:
    out = tmp_path / "out"
    _, stderr = (process := run(behaviour, tmp_path / "scene", "-o", out)).communicate(timeout=PATIENCE_S)
    assert process.returncode == code
    errors = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in stderr
    assert out.exists() == (code == 1)  # bad input leaves nothing that blocks the corrected command


def test_run_plgs_help_is_complete_and_imports_no_large_package(root: Path) -> None:
    code = (
        "import sys, runpy; sys.argv = ['run_plgs.py', '--help']\n"
        "try: runpy.run_path(sys.argv[0], run_name='__main__')\n"
        "finally: print('HEAVY', {'torch', 'bpy', 'numpy', 'cv2'} & set(sys.modules))"
    )
    said = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=PATIENCE_S)
    assert said.returncode == 0 and "HEAVY set()" in said.stdout
    for option in "SCENE -o --preset --steps --size --seed --masks --up --bake --save --resume".split():
        assert option in said.stdout


def test_run_plgs_finds_bad_input_before_it_makes_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", sys.executable)
    scene = write_tiny_scene(tmp_path / "scene")
    out = tmp_path / "out"
    used = tmp_path / "used"
    used.mkdir()
    (used / "diary.txt").write_text("private")
    (tmp_path / "notes.blend").write_text("no blend")
    (tmp_path / "old").mkdir()
    (tmp_path / "old/lift.blend").write_text("no blend")
    for arguments, told in (
        ((tmp_path / "nowhere", "-o", out), "nowhere"),
        ((scene, "-o", out, "--steps", "0"), "steps = 0"),
        ((scene, "-o", out, "--steps", "many"), "many"),
        ((scene, "-o", out, "--size", "640"), "640"),
        ((scene, "-o", out, "--size", "2x2"), "(2, 2)"),
        ((scene, "-o", out, "--preset", "best"), "best"),
        ((scene, "-o", out, "--seed", "-1"), "'seed' must be a whole number from 0 to 4294967295, not -1"),
        ((scene, "-o", out, "--save", tmp_path / "a.txt"), ".blend"),
        ((scene, "-o", out, "--save", tmp_path / "no" / "a.blend"), str(tmp_path / "no")),
        ((scene, "-o", out, "--save", tmp_path / "notes.blend"), "not a Blender file"),
        ((scene, "-o", tmp_path / "old"), "not a Blender file"),
        ((scene, "-o", used), "diary.txt"),
        ((scene, "-o", used, "--resume"), "diary.txt"),
        ((scene, "-o", scene / "color" / "0000.png"), "0000.png"),
        ((scene,), "-o"),
        *((("-o", out, "--bake", "camera", "--range", text), repr(text)) for text in ("5--10", "9-2", "1-", "x")),
    ):
        assert exit_code(run_plgs.main, *arguments) == 2, arguments
        said = capsys.readouterr().err
        assert told in said and said.count("error: ") == 1 and not out.exists()
    assert [path.name for path in used.iterdir()] == ["diary.txt"]


def test_modules_in_a_scene_are_never_run_even_from_its_folder(root: Path, tmp_path: Path) -> None:
    """cd scene; run_plgs.py . -o OUT"""
    for name in ("importlib", "json", "engine", "plgs", "torch", "bpy"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"open({str(tmp_path / 'run')!r}, 'w')")
    command = [sys.executable, root / "run_plgs.py", ".", "-o", tmp_path / "out"]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, env=env())
    assert said.returncode == 2 and worded("no-format").search(said.stderr)
    assert not (tmp_path / "run").exists() and not (tmp_path / "out").exists()


def test_run_plgs_without_bpy_says_what_to_do(root: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", bare], check=True, timeout=120)
    packages = bare / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    for name in ("torch", "numpy"):
        (packages / f"{name}.py").write_text("")
    python = bare / "bin" / "python"
    command = [python, root / "run_plgs.py", tmp_path, "-o", tmp_path / "out"]
    env = os.environ | {"PLGS_ENGINE_PYTHON": str(python)}
    said = subprocess.run(command, capture_output=True, text=True, timeout=60, env=env)
    assert said.returncode == 2 and "bpy" in said.stderr and "make set-up" in said.stderr
    assert len(said.stderr.splitlines()) == 1


def test_the_engine_ends_when_run_plgs_is_killed_even_if_it_was_suspended(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = run("patient", tmp_path / "scene", "-o", out)
    wait_for(process, has_begun(out))
    engine = int(str(next(event.data["pid"] for event in last_run(out / "events.jsonl"))))
    os.kill(engine, signal.SIGSTOP)
    process.kill()
    process.wait()
    assert LiftFolder.open(out).is_running
    os.kill(engine, signal.SIGCONT)
    wait_until(lambda: not LiftFolder.open(out).is_running, out)
    assert LiftFolder.open(out).state() is LiftState.CANCELLED


def test_a_lift_continues_without_its_terminal_and_says_so_in_its_log(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = root / "tests" / "job" / "run_plgs_with_fake_engine.py"
    command = [sys.executable, script, "patient", tmp_path / "scene", "-o", out]
    process = subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=env())
    process.stdout.readline()
    process.stdout.close()  # as `2>&1 | head -1` does
    wait_for(process, has_begun(out))
    wait_for(process, lambda: "The terminal was closed. The work continues." in (out / "log.txt").read_text())
    process.send_signal(signal.SIGHUP)
    assert process.wait(PATIENCE_S) == 129
    lift = LiftFolder.open(out)
    assert not lift.is_running and lift.state() is LiftState.CANCELLED


def test_run_plgs_with_a_closed_output_pipe_has_its_own_exit_code(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = run("short", tmp_path / "scene", "-o", out)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    stderr = process.stderr.read()
    assert process.wait(PATIENCE_S) == 141 and "Traceback" not in stderr
    assert LiftFolder.open(out).state() is LiftState.FINISHED


def test_run_plgs_refuses_a_read_only_lift(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    run("short", tmp_path / "scene", "-o", out).communicate(timeout=PATIENCE_S)
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    with raises_key("read-only"):
        LiftFolder.open(out).refuse_read_only()
    with pytest.raises(Exception, match=worded("read-only")):  # of the package plgs, which run_plgs.py imports
        run_plgs.build_blend(LiftFolder.open(out), out / "lift.blend")
