"""The set-up: which Python it takes, what it installs, when an environment counts as complete."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
REQUIREMENTS = ROOT / "requirements"
HERE = f"{sys.version_info[0]}.{sys.version_info[1]}"


def load_environment() -> ModuleType:
    spec = importlib.util.spec_from_file_location("set_up_environment", ROOT / "set_up" / "environment.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


environment = load_environment()


def requirement_lines(name: str) -> list[str]:
    lines = (REQUIREMENTS / name).read_text().splitlines()
    return [line.partition(";")[0].strip() for line in lines if line and not line.startswith("#")]


def pins(name: str) -> dict[str, str]:
    parts = (line.partition("==") for line in requirement_lines(name))
    return {package.lower().replace("_", "-"): version for package, _, version in parts}


@pytest.mark.parametrize(
    "name", ["blender-4.5.txt", "blender-5.3.txt", "torch.txt", "engine.txt", "test.txt", "segment.txt", "farm.txt"]
)
def test_all_requirements_are_pinned(name: str) -> None:
    assert all("==" in line for line in requirement_lines(name))


@pytest.mark.parametrize(("version", "blender"), [((3, 11), "blender-4.5.txt"), ((3, 13), "blender-5.3.txt")])
def test_the_constraints_agree_with_the_requirements(version: tuple[int, int], blender: str) -> None:
    locked = pins(environment.constraints(version))
    asked = {**pins(blender), **pins("test.txt"), **pins("engine.txt"), **pins("segment.txt"), **pins("farm.txt")}
    del asked["open3d"]  # for other systems than Linux
    asked["scipy"] = locked["scipy"]  # one line a Python version
    assert {package: locked.get(package) for package in asked} == asked
    assert all(line in locked for line in (name.lower() for name in requirement_lines("next.txt")))


def test_a_python_without_a_blender_has_no_recipe() -> None:
    with pytest.raises(ValueError, match="no Blender runs on Python 3.12"):
        environment.recipe(".venv", (3, 12))


def test_the_next_environment_has_no_torch() -> None:
    calls = environment.recipe(".venv-next", (3, 13)).pip_calls
    assert [name for call in calls for name in call] == ["blender-5.3.txt", "next.txt"]


def test_complete_means_stamped_with_exactly_these_requirements(tmp_path: Path) -> None:
    requirements = shutil.copytree(REQUIREMENTS, tmp_path / "requirements")
    folder = tmp_path / ".venv"
    folder.mkdir()
    assert not environment.is_complete(folder, (3, 11), requirements)
    (folder / "complete").write_text(environment.stamp_text(".venv", (3, 11), requirements))
    assert environment.is_complete(folder, (3, 11), requirements)
    assert not environment.is_complete(folder, (3, 13), requirements)
    with (requirements / "engine.txt").open("a") as file:
        file.write("one-more==1.0\n")
    assert not environment.is_complete(folder, (3, 11), requirements)


@pytest.fixture
def workshop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """A temporary repository root on a machine that lacks nothing. Commands are recorded and not run."""
    commands: list[list[str]] = []

    def note(command: list[str], failure: str, **options: object) -> None:
        commands.append(command)
        if "venv" in command:
            Path(command[-1]).mkdir()

    shutil.copytree(REQUIREMENTS, tmp_path / "requirements")
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    monkeypatch.setattr(environment, "missing_packages", lambda: [])
    monkeypatch.setattr(environment, "run", note)
    return commands


def test_an_interrupted_set_up_is_repaired(
    tmp_path: Path, workshop: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    note: Callable[..., None] = environment.run

    def cut_off(command: list[str], failure: str, **options: object) -> None:
        if "pip" in command:
            raise KeyboardInterrupt
        note(command, failure)

    monkeypatch.setattr(environment, "run", cut_off)
    with pytest.raises(KeyboardInterrupt):
        environment.main(["make", ".venv"])
    (tmp_path / ".venv" / "half-installed").touch()
    assert environment.main(["check", ".venv"]) == 1

    monkeypatch.setattr(environment, "run", note)
    assert environment.main(["make", ".venv"]) == 0
    assert not (tmp_path / ".venv" / "half-installed").exists()
    assert environment.main(["check", ".venv"]) == 0

    workshop.clear()
    assert environment.main(["make", ".venv"]) == 0
    assert workshop == []


def test_the_index_of_cpu_builds_is_used_only_for_torch(
    workshop: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_INDEX", "file:///cpu-builds")
    environment.main(["make", ".venv"])
    asked = [("torch.txt" in command, "file:///cpu-builds" in command) for command in workshop if "pip" in command]
    assert asked == [(True, True), (False, False)]


@pytest.mark.parametrize(("folder", "version", "warm"), [(".venv", (3, 11), True), (".venv-next", (3, 13), False)])
def test_the_engine_is_compiled_where_it_runs(
    workshop: list[list[str]], monkeypatch: pytest.MonkeyPatch, folder: str, version: tuple[int, int], warm: bool
) -> None:
    monkeypatch.setattr(environment.sys, "version_info", (*version, 0))
    environment.main(["make", folder])
    assert (workshop[-1][1:] == ["-m", "engine", "warm-up"]) is warm


def test_settings_that_send_packages_elsewhere_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_TARGET", "/elsewhere")
    monkeypatch.setenv("PIP_USER", "1")
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels")
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    kept = environment.pip_environment()
    assert not {"PIP_TARGET", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE"} & set(kept)
    assert kept["PIP_USER"] == "0"
    assert kept["PIP_FIND_LINKS"] == "/wheels"


def test_without_root_the_missing_packages_are_named_in_one_apt_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(SystemExit) as stopped:
        environment.install_packages(["libgl1", "libegl1"])
    assert stopped.value.code == 1
    assert "\n    sudo apt-get install --no-install-recommends libgl1 libegl1\n" in capsys.readouterr().err


def find_python(version: str, *folders: Path) -> str:
    path = os.pathsep.join([*map(str, folders), "/usr/bin", "/bin"])
    command = ["sh", str(ROOT / "set_up" / "find_python.sh"), version]
    return subprocess.run(
        command, env={"PATH": path}, capture_output=True, text=True, check=True, timeout=120
    ).stdout.strip()


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_a_python_that_only_says_why_it_does_not_run_is_skipped(tmp_path: Path) -> None:
    shim = executable(tmp_path / "shims" / f"python{HERE}", "echo 'command exists in these versions' >&2; exit 127")
    real = executable(tmp_path / "real" / f"python{HERE}", f'exec "{sys.executable}" "$@"')
    assert find_python(HERE, shim.parent, real.parent) == sys.executable


def test_a_python_that_pyenv_has_but_does_not_show_is_found(tmp_path: Path) -> None:
    (tmp_path / "pyenv" / "versions" / f"{HERE}.99").mkdir(parents=True)
    real = executable(tmp_path / "pyenv" / "versions" / f"{HERE}.99" / "bin" / f"python{HERE}", "exit 1")
    executable(real, f'exec "{sys.executable}" "$@"')
    shim = executable(tmp_path / "shims" / f"python{HERE}", "exit 127")
    executable(shim.parent / "python3", "exit 127")
    pyenv = executable(tmp_path / "shims" / "pyenv", f'echo "{tmp_path / "pyenv"}"')
    found = subprocess.run(
        ["/bin/sh", str(ROOT / "set_up" / "find_python.sh"), HERE],
        env={"PATH": str(pyenv.parent)}, capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    assert found.stdout.strip() == sys.executable


@pytest.mark.parametrize(
    ("release", "told"),
    [
        ('ID=ubuntu\nVERSION_ID="22.04"\nID_LIKE=debian', "sudo apt-get install python3.11 python3.11-venv"),
        ('ID=ubuntu\nVERSION_ID="24.04"\nID_LIKE=debian', "uv python install 3.11"),
        ('ID=ubuntu\nVERSION_ID="25.10"\nID_LIKE=debian', "sudo apt-get install python3 python3-venv"),
        ('ID=debian\nVERSION_ID="12"', "sudo apt-get install python3 python3-venv"),
        ("ID=fedora\nVERSION_ID=43", "sudo dnf install python3.13"),
        ('ID="rocky"\nVERSION_ID="10.0"\nID_LIKE="rhel centos fedora"', "uv python install 3.11"),
        ('ID=arch\nNAME="Arch Linux"', "uv python install 3.11"),
        (None, "uv python install 3.11"),
    ],
)
def test_where_no_python_fits_the_system_is_told_what_helps(tmp_path: Path, release: str | None, told: str) -> None:
    for name in ("set_up", "bin"):
        (tmp_path / name).mkdir()
    for name in ("set_up.sh", "find_python.sh"):
        shutil.copy(ROOT / "set_up" / name, tmp_path / "set_up")
    for tool in ("sh", "dirname", "cat"):
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool) or "")
    if release is not None:
        (tmp_path / "os-release").write_text(release + "\n")
    said = subprocess.run(
        [tmp_path / "bin/sh", tmp_path / "set_up/set_up.sh", ".venv"], capture_output=True, text=True, timeout=60,
        env={"PATH": str(tmp_path / "bin"), "OS_RELEASE": str(tmp_path / "os-release")}, check=False,
    )  # fmt: skip
    assert said.returncode == 1 and said.stdout == "" and told in said.stderr.splitlines()[-1]
    assert said.stderr.splitlines()[0].endswith("Install one, then run make again:")


@pytest.mark.parametrize("program", ["dnf", "zypper"])
def test_on_rpm_systems_libraries_are_named_by_their_files(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], program: str
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if name == program else None)
    with pytest.raises(SystemExit):
        environment.install_packages(["libgl1", "libegl1"])
    assert f"\n    sudo {program} install 'libGL.so.1()(64bit)' 'libEGL.so.1()(64bit)'\n" in capsys.readouterr().err


def test_a_system_that_is_too_old_for_open3d_is_told_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(environment.platform, "libc_ver", lambda: ("glibc", "2.34"))
    with pytest.raises(SystemExit):
        environment.refuse_old_system()
    assert "needs glibc 2.35" in capsys.readouterr().err
    for name, release in (("glibc", "2.35"), ("", "")):
        monkeypatch.setattr(environment.platform, "libc_ver", lambda told=(name, release): told)
        environment.refuse_old_system()


def test_where_no_python_fits_nothing_is_printed(tmp_path: Path) -> None:
    assert find_python("3.99", tmp_path) == ""
