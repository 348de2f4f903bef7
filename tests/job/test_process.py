"""Which Python runs the engine, and how a program is ended."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from engine.job import environment
from engine.job.handshake import VERSION
from engine.job.process import (
    ChildProcess,
    Origin,
    choose_python,
    clean_environment,
    engine_call,
    engine_python,
    missing_modules,
)
from engine.job.system import SHARE, MainMemory, main_memory
from engine.user_cache import user_cache_folder
from tests.raises_key import raises_key, worded
from tests.waiting import wait_until


def add_environment(folder: Path) -> Path:
    environment.python_in(folder).parent.mkdir(parents=True)
    environment.python_in(folder).symlink_to(sys.executable)
    return environment.python_in(folder)


@pytest.fixture
def code(root: Path, tmp_path: Path) -> Path:
    """The code in a folder of its own, without an environment beside it."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "requirements").symlink_to(root / "requirements")
    return tmp_path / "code"


@pytest.fixture
def environ(tmp_path: Path) -> dict[str, str]:
    cache = str(tmp_path / "cache")
    return {"XDG_CACHE_HOME": cache, "LOCALAPPDATA": cache}


@pytest.mark.skipif(sys.platform == "darwin", reason="the cache folder cannot be chosen there")
def test_pythons_for_the_engine_are_tried_in_order(
    code: Path, environ: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with raises_key("no-python"):
        choose_python(code, environ)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    found = [choose_python(code, environ)]
    beside = add_environment(code / ".venv")
    found.append(choose_python(code, environ))
    folder = environment.environments_folder(environ) / environment.environment_name(code, (3, 13))
    made = add_environment(folder)
    assert choose_python(code, environ).origin is Origin.BESIDE  # it is not complete
    (folder / environment.COMPLETE).touch()
    found.append(choose_python(code, environ))
    found.append(choose_python(code, environ, tmp_path / "mine"))
    found.append(choose_python(code, environ | {"PLGS_ENGINE_PYTHON": "/theirs"}, tmp_path / "mine"))
    assert [choice.origin for choice in found] == list(Origin)[::-1]
    pythons = [choice.python for choice in found]
    assert pythons == [Path(sys.executable), beside, made, tmp_path / "mine", Path("/theirs").absolute()]


def test_an_environment_with_other_requirements_is_not_used(code: Path, environ: dict[str, str]) -> None:
    for name, counts in (("engine-3.11-000000000000", False), (environment.environment_name(code, (3, 11)), True)):
        folder = environment.environments_folder(environ) / name
        python = add_environment(folder)
        (folder / environment.COMPLETE).touch()
        assert environment.is_complete(folder)
        assert environment.made_environment(code, environ) == (folder if counts else None)
    assert environment.made_environment(code / "no code", environ) is None
    python.unlink()
    python.symlink_to("/uninstalled/python3.11")
    assert environment.made_environment(code, environ) is None


def test_without_a_home_folder_no_cache_folder_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    # A container's user, whose number no table of users has.
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError("Could not determine home directory.")))
    assert not user_cache_folder().exists()


def test_a_chosen_python_that_lacks_packages_is_refused(code: Path, tmp_path: Path) -> None:
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')  # without its packages
    script.chmod(0o755)
    with raises_key("python-unfit torch") as refused:
        engine_python(code, {}, script)
    assert "preferences" in refused.value.fix


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX process groups")
def test_ending_a_program_ends_its_child_processes(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    code = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        f"open({str(pid_file)!r}, 'w').write(str(child.pid)); time.sleep(600)"
    )
    with (tmp_path / "log").open("wb") as log:
        process = ChildProcess([sys.executable, "-c", code], cwd=tmp_path, environment=clean_environment(), output=log)
    wait_until(lambda: pid_file.exists() and pid_file.read_text(), pid_file)
    process.kill()
    assert process.exit_code() == -9
    child = int(pid_file.read_text())
    wait_until(lambda: not _lives(child), child)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(sys.platform == "win32", reason="shell scripts")
@pytest.mark.parametrize(
    ("body", "told"), [("true", "not-a-python"), ('echo "$@"', "not-a-python"), ("sleep 9", "silent")]
)
def test_programs_other_than_python_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, told: str) -> None:
    script = tmp_path / "python"
    script.write_text(f"#!/bin/sh\nexec {body}\n" if told == "silent" else f"#!/bin/sh\n{body}\n")
    script.chmod(0o755)
    if told == "silent":
        monkeypatch.setattr("engine.job.process._ANSWER_S", 0.2)
    with raises_key(told):
        missing_modules(script, ["torch"])


def test_text_that_a_python_prints_at_startup_is_ignored(tmp_path: Path) -> None:
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\necho hello\nexec {sys.executable} "$@"\n')
    script.chmod(0o755)
    assert missing_modules(script, ["json", "no_such_module"]) == ["no_such_module"]


def test_a_path_that_cannot_be_an_argument_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as log, raises_key("bad-path"):
        ChildProcess([sys.executable, "a\0b"], cwd=tmp_path, environment={}, output=log)


def test_modules_in_the_current_folder_never_run(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene of somebody else's may hold a folder `importlib`, and be where the engine is started."""
    for name in ("importlib", "json", "engine", "argparse", "torch"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"open({str(tmp_path / 'run')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert missing_modules(Path(sys.executable), ["json", "no_such_module"]) == ["no_such_module"]
    command = [str(part) for part in engine_call(Path(sys.executable))]
    said = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=60)
    assert said.stdout == f"{VERSION}\n" and said.stderr == ""
    said = subprocess.run([*command, "inspect", "."], capture_output=True, text=True, timeout=60)
    assert said.returncode == 2 and worded("no-format").search(said.stderr)
    assert not (tmp_path / "run").exists()


def test_every_package_that_a_lift_imports_is_pinned(root: Path) -> None:
    assert environment.pinned_versions(root) == ((3, 11), (3, 13))
    for version in environment.pinned_versions(root):
        needed = environment.needed_packages(root, version)
        assert next(iter(needed)) == "torch" and all(needed.values())
        assert {environment.module_of(name) for name in needed} == {
            "torch", "open3d", "cv2", "OpenEXR", "numba", "scipy", "safetensors", "lz4", "pycocotools", "numpy",
        }  # fmt: skip
    assert environment.needed_packages(root, (3, 11))["scipy"] != environment.needed_packages(root, (3, 13))["scipy"]
    assert environment.needed_packages(root, (3, 12))["numpy"] is None


def test_linux_windows_and_macos_pin_the_same_packages(root: Path) -> None:
    needs = [environment.needed_packages(root, (3, 11), platform) for platform in ("linux", "win32", "darwin")]
    pins = [{environment.module_of(name): pin for name, pin in need.items()} for need in needs]
    assert pins[0] == pins[1] == pins[2] and environment.needed_packages(root, (3, 11)) in needs


def test_changed_requirements_mean_a_new_environment(root: Path, tmp_path: Path) -> None:
    shutil.copytree(root / "requirements", tmp_path / "requirements")
    before = environment.digest(tmp_path, (3, 11))
    assert before == environment.digest(root, (3, 11)) != environment.digest(root, (3, 13))
    with environment.requirement_file(tmp_path, "constraints", (3, 11)).open("a") as file:
        file.write("one-more==1.0\n")
    assert environment.digest(tmp_path, (3, 11)) != before


def test_unreadable_requirements_files_are_reported(root: Path, tmp_path: Path) -> None:
    with raises_key("unreadable torch.txt"):
        environment.needed_packages(tmp_path, (3, 11))
    shutil.copytree(root / "requirements", tmp_path / "requirements")
    (tmp_path / "requirements" / "torch.txt").write_text('torch==1.0; os_name == "nt"\n')
    with raises_key("odd-condition os_name"):
        environment.needed_packages(tmp_path, (3, 11))


INFO = "MemTotal:       1000 kB\nMemFree:         100 kB\nMemAvailable:    600 kB\nHugePages_Total:   0\n"


@pytest.mark.parametrize(
    ("limit", "held", "share", "memory"),
    [
        ("", 0, "", (1_024_000, 614_400)),
        ("max\n", 5, "", (1_024_000, 614_400)),
        ("500000\n", 100_000, "", (500_000, 400_000)),
        ("500000", 900_000, "", (500_000, 0)),
        ("900000000", 0, "", (1_024_000, 614_400)),
        ("", 0, "0.0005", (500_000, 500_000)),
        ("", 0, "5", (1_024_000, 614_400)),
    ],
)
def test_free_memory_respects_the_limit_of_a_container(
    limit: str, held: int, share: str, memory: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "meminfo").write_text(INFO)
    if limit:
        (tmp_path / "memory.max").write_text(limit)
        (tmp_path / "memory.current").write_text(str(held))
    if share:
        monkeypatch.setenv(SHARE, share)
    assert main_memory(tmp_path, tmp_path) == MainMemory(*memory)


@pytest.mark.parametrize(
    ("group", "limit", "held", "cached"),
    [
        ("0::/system.slice/slurmstepd.scope/job_7/step_0\n", "memory.max", "memory.current", "inactive_file"),
        ("5:cpu,memory:/slurm/job_7/step_0\n", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ],
)
def test_free_memory_respects_a_farm_jobs_limit(group: str, limit: str, held: str, cached: str, tmp_path: Path) -> None:
    """The limit of the job's cgroup holds for the processes of its steps, as sbatch and systemd-run make them."""
    (tmp_path / "self").mkdir()
    (tmp_path / "self/cgroup").write_text(group)
    (tmp_path / "meminfo").write_text(INFO)
    top = tmp_path / "memory" if "memory" in group else tmp_path
    job = (top / group.strip().rpartition(":")[2].lstrip("/")).parent
    (job / "step_0").mkdir(parents=True)
    (job / limit).write_text("500000")
    (job / held).write_text("300000")
    (job / "memory.stat").write_text(f"{cached} 100000")
    assert main_memory(tmp_path, tmp_path) == MainMemory(500_000, 300_000)


@pytest.mark.parametrize("text", ["", "MemTotal: 5 kB", "MemTotal: x\n", "MemTotal:\nMemAvailable:\n"])
def test_an_unreadable_meminfo_means_unknown_memory(tmp_path: Path, text: str) -> None:
    (tmp_path / "meminfo").write_text(text)
    assert main_memory(tmp_path, tmp_path) is None
