"""The set-up: which Python it takes, what it installs, when an environment counts as complete."""

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
def test_all_python_requirements_are_pinned(name: str) -> None:
    assert all("==" in line for line in requirement_lines(name))


@pytest.mark.parametrize(("version", "blender"), [((3, 11), "blender-4.5.txt"), ((3, 13), "blender-5.3.txt")])
def test_constraints_files_agree_with_the_requirements(version: tuple[int, int], blender: str) -> None:
    locked = pins(environment.constraints(version))
    asked = {**pins(blender), **pins("test.txt"), **pins("engine.txt"), **pins("segment.txt"), **pins("farm.txt")}
    del asked["open3d"]  # for other systems than Linux
    asked["scipy"] = locked["scipy"]  # one line a Python version
    assert {package: locked.get(package) for package in asked} == asked
    assert all(line in locked for line in (name.lower() for name in requirement_lines("next.txt")))


def test_make_set_up_is_complete_only_for_the_current_requirements(tmp_path: Path) -> None:
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
    monkeypatch.setattr(environment.uv_program, "fetch", lambda *_: Path("/uv"))
    monkeypatch.setattr(environment, "find_python", lambda uv, name: ("python", tuple(sys.version_info[:2])))
    monkeypatch.setattr(environment, "missing_packages", lambda: [])
    monkeypatch.setattr(environment, "run", note)
    return commands


def test_a_cut_off_set_up_is_redone(tmp_path: Path, workshop: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_the_cpu_index_is_used_only_for_torch(workshop: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_INDEX", "file:///cpu-builds")
    environment.main(["make", ".venv"])
    asked = [("torch.txt" in command, "file:///cpu-builds" in command) for command in workshop if "pip" in command]
    assert asked == [(True, True), (True, False)], "the second brings what torch needs"


def test_missing_system_packages_give_one_apt_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(SystemExit) as stopped:
        environment.install_packages(["libgl1", "libegl1"])
    assert stopped.value.code == 1
    assert "\n    sudo apt-get install --no-install-recommends libgl1 libegl1\n" in capsys.readouterr().err


def pretended_uv(path: Path, *found: str) -> Path:
    """A uv that finds these Pythons alone."""
    names = "|".join(found or ("none",))
    path.write_text(f'#!/bin/sh\nfor name; do :; done\ncase "$name" in {names}) exit 0 ;; esac\nexit 2\n')
    path.chmod(0o755)
    return path


def test_make_set_up_downloads_python_only_if_none_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path / "pyenv"))
    hidden = tmp_path / "pyenv/versions/3.13.9/bin/python3.13"
    hidden.parent.mkdir(parents=True)
    hidden.touch()
    uv = tmp_path / "uv"
    for found, version in (
        ((), "3.11"),
        (("3.13",), "3.13"),
        (("3.11", "3.13"), "3.11"),
        ((str(hidden),), str(hidden)),
    ):
        assert environment.find_python(pretended_uv(uv, *found), ".venv")[0] == version
    assert environment.find_python(uv, ".venv-next") == ("", (3, 13)), "not where .venv has it already"
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / ".venv/bin/python3.11").touch()
    assert environment.find_python(uv, ".venv-next") == (str(hidden), (3, 13))
    assert environment.find_python(pretended_uv(uv), ".venv-next") == ("", (3, 13)), "it is not downloaded"


def test_make_set_up_without_python_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "set_up").mkdir()
    shutil.copy(ROOT / "set_up/set_up.sh", tmp_path / "set_up")
    for tool in ("sh", "dirname"):
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool) or "")
    script = (ROOT / "set_up/set_up.sh").read_text().replace(" /usr/bin/python3;", ";")
    (tmp_path / "set_up/set_up.sh").write_text(script)
    command = [tmp_path / "bin/sh", tmp_path / "set_up/set_up.sh", ".venv"]
    said = subprocess.run(command, capture_output=True, text=True, env={"PATH": str(tmp_path / "bin")}, check=False)
    assert said.returncode == 1 and "install.sh" in said.stderr.splitlines()[-1]


@pytest.mark.parametrize("program", ["dnf", "zypper"])
def test_make_set_up_names_missing_files_on_rpm_systems(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], program: str
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if name == program else None)
    with pytest.raises(SystemExit):
        environment.install_packages(["libgl1", "libegl1"])
    assert f"\n    sudo {program} install 'libGL.so.1()(64bit)' 'libEGL.so.1()(64bit)'\n" in capsys.readouterr().err


def test_make_set_up_refuses_a_system_that_is_too_old(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(environment.platform, "libc_ver", lambda: ("glibc", "2.34"))
    with pytest.raises(SystemExit):
        environment.refuse_old_system()
    assert "needs glibc 2.35" in capsys.readouterr().err
    for name, release in (("glibc", "2.35"), ("", "")):
        monkeypatch.setattr(environment.platform, "libc_ver", lambda told=(name, release): told)
        environment.refuse_old_system()
