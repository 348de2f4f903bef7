"""Setting the engine up with a real pip from an index on this machine: to the end, cut off, and gone on with."""

from __future__ import annotations

import ensurepip
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from engine.job.environment import is_complete, python_in
from engine.set_up import SetUpRequest, pip_wheel, programs, remove_environments, steps
from engine.set_up.environments import Notes
from tests.raises_key import worded
from tests.set_up.package_index import PackageIndex, wheel
from tests.set_up.running import RunningSetUp
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals and links")
Begin = Callable[..., RunningSetUp]


def environment_in(folder: Path) -> Path:
    return next(folder.glob("engine-*"))


def error_of(running: RunningSetUp) -> str:
    assert running.wait().error is not None, running.labels
    return str(running.error)


def lives(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def pips_of(folder: Path) -> list[int]:
    """The pips that work in an environment."""
    python = str(python_in(environment_in(folder))).encode()
    commands = {int(each.name): each / "cmdline" for each in Path("/proc").iterdir() if each.name.isdigit()}
    found = []
    for pid, path in commands.items():
        try:
            is_ours = path.read_bytes().startswith(python)
        except OSError:
            continue
        if is_ours and lives(pid):
            found.append(pid)
    return found


def test_from_an_empty_environment_to_an_engine_that_answers(folder: Path, begin: Begin, index: PackageIndex) -> None:
    running = begin().wait()
    assert running.error is None and is_complete(environment_in(folder))
    assert running.python == python_in(environment_in(folder))
    assert sorted(index.downloads) == sorted(index.wheels)
    assert running.fractions == sorted(running.fractions) and running.fractions[-1] >= 0.98
    begun = [label.partition(":")[0] for label in running.labels]
    assert list(dict.fromkeys(begun)) == list(steps.LABELS)
    assert any("Writing" in label for label in running.labels)
    log = running.set_up.log_path.read_text()
    assert "compiled for" in log and "os, 'sync'" in log, "the packages are synced before the environment counts"
    assert {path.name for path in folder.iterdir()} == {environment_in(folder).name, "set-up.log", "set-up.lock"}
    index.downloads.clear()
    assert begin().wait().python == running.python and index.downloads == []
    (folder / "engine-mine").mkdir()  # no environment
    remove_environments(folder)
    assert {path.name for path in folder.iterdir()} == {"engine-mine", "set-up.log", "set-up.lock"}


def test_a_python_without_ensurepip_gets_pip_from_the_index(
    code: Path, index: PackageIndex, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Debian's Python without python3-venv is such a one."""
    bare = tmp_path / "bare"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", bare], check=True)
    hiding = bare / "lib" / "python{}.{}".format(*sys.version_info[:2]) / "site-packages" / "sitecustomize.py"
    hiding.write_text("import sys\nsys.modules['ensurepip'] = None\n")
    (bundled,) = (Path(ensurepip.__file__).parent / "_bundled").glob("pip-*.whl")
    index.wheels["pip"] = (bundled.name, bundled.read_bytes())
    monkeypatch.setattr(pip_wheel, "WHEEL", bundled.name)
    request = SetUpRequest(python_in(bare), index_url=index.url)
    told = error_of(RunningSetUp(request, code, tmp_path / "refused"))
    assert bundled.name in told and "pinned" in told, "another file of that name"
    monkeypatch.setattr(pip_wheel, "SHA256", hashlib.sha256(bundled.read_bytes()).hexdigest())
    running = RunningSetUp(request, code, tmp_path / "made").wait()
    assert running.error is None and is_complete(environment_in(tmp_path / "made"))


def test_an_interrupted_download_is_reported_and_continued(begin: Begin, index: PackageIndex, folder: Path) -> None:
    index.fault["numba"] = "cut"
    told = error_of(begin())
    assert "pip could not install packages" in told and "continues there" in told and "set-up.log" in told
    notes = Notes.read(environment_in(folder))
    assert notes is not None and notes.done == ["torch"] and not is_complete(environment_in(folder))
    index.fault.clear()
    assert begin().wait().python is not None
    assert index.downloads.count("torch") == 1


def test_a_broken_wheel_is_reported(begin: Begin, index: PackageIndex) -> None:
    index.fault["torch"] = "garbage"
    told = error_of(begin())
    assert "pip could not install torch" in told and "wheel" in told.lower()


def test_a_wheel_that_was_replaced_is_refused(begin: Begin, index: PackageIndex) -> None:
    name, _ = index.wheels["numba"]
    index.wheels["numba"] = name, wheel("numba", name.split("-")[1], "other")[1]
    assert "DO NOT MATCH THE HASHES" in error_of(begin())


def test_the_password_of_an_index_stays_out_of_log_and_message(begin: Begin, index: PackageIndex) -> None:
    index.fault["scipy"] = "garbage"
    running = begin(url=index.url.replace("http://", "http://me:secret@"))
    assert "secret" not in error_of(running) and not any("secret" in label for label in running.labels)
    log = running.set_up.log_path.read_text()
    assert "pip install" in log and "secret" not in log


def test_the_users_hash_policy_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PIP_REQUIRE_HASHES", "1")
    assert programs.pip_environment(tmp_path)["PIP_REQUIRE_HASHES"] == "1"


def test_cancel_ends_pip_at_once(begin: Begin, index: PackageIndex, folder: Path) -> None:
    index.fault["torch"] = "stall"
    running = begin().wait(until=index.stalled.is_set)
    running.wait(until=lambda: "Downloading torch" in running.label)
    assert pips_of(folder)
    running.cancel()
    assert not pips_of(folder), "pip itself waits longer than `cancel` does"
    assert running.python is None and running.error is None
    index.fault.clear()
    again = begin()  # the lock is free
    again.wait(until=lambda: any("Installing torch" in label for label in again.labels))


@pytest.mark.slow
def test_after_a_kill_the_next_set_up_waits_for_the_remaining_pip(
    begin: Begin, index: PackageIndex, folder: Path, code: Path, root: Path, tmp_path: Path
) -> None:
    """Two set-ups and a kill: the pip of the killed one holds the lock on, the other goes on after it."""
    index.fault["torch"] = "stall"
    script = f"""
import sys; sys.path.insert(0, {str(root)!r})
from pathlib import Path
from engine.set_up import steps
from tests.set_up.running import RunningSetUp, SetUpRequest
steps.NEEDED_BYTES = {{"cpu": 0}}  # its packages are tiny
request = SetUpRequest(Path(sys.executable), "cpu", {index.url!r})
RunningSetUp(request, Path({str(code)!r}), Path({str(folder)!r})).wait()
"""
    first = subprocess.Popen([sys.executable, "-c", script])
    try:
        assert index.stalled.wait(PATIENCE_S)
        second = begin()
        second.wait(until=lambda: any("Another set-up" in label for label in second.labels))
    finally:
        first.send_signal(signal.SIGKILL)
        first.wait()
    time.sleep(0.3)
    assert "Another set-up" in second.label and len(pips_of(folder)) == 1
    index.fault.clear()
    index.go_on.set()
    assert second.wait().python is not None


def test_what_may_be_half_written_is_made_again(begin: Begin, folder: Path) -> None:
    """Killed while pip wrote packages, or made with another torch."""
    environment = environment_in(folder)
    for notes, build in ((Notes("cpu", ["torch"], installing=True), "cpu"), (Notes("cpu", ["torch"]), "cuda")):
        environment.mkdir(exist_ok=True)
        notes.write(environment)
        (environment / "half").touch()
        running = begin(build=build)
        running.wait(until=lambda: not (environment / "half").exists())
        running.cancel()
    assert [path.name for path in sorted(folder.glob("trash-*"))] == ["trash-0", "trash-1"]


def test_a_complete_environment_that_does_not_answer_is_made_again(begin: Begin, folder: Path) -> None:
    environment = environment_in(folder)
    (environment / "complete").touch()  # but nothing is installed
    (environment / "old").touch()
    begin().wait(until=lambda: not (environment / "old").exists())


def test_where_no_python_can_make_environments_says_why(begin: Begin, tmp_path: Path) -> None:
    debian = '[[3, 11], "/usr/bin/python3.11", ["venv", "ensurepip"]]'
    for number, (words, told) in enumerate((
        (f"echo '{debian}'", "lacks venv and ensurepip (on Debian and Ubuntu: python3.11-venv)"),
        ("echo '[[3, 99], \"/p\", []]'", "is Python 3.99, which the packages are not pinned for"),
        ("exit 1", "does not work as a Python"),
        ("echo hello", "does not work as a Python"),
    )):  # fmt: skip
        python = tmp_path / f"python {number}"
        python.write_text(f"#!/bin/sh\n{words}\n")
        python.chmod(0o755)
        error = error_of(begin(base=str(python)))
        assert told in error and "Install Python 3.11 or 3.13" in error
    assert worded("not-runnable").search(error_of(begin(base=str(tmp_path / "none"))))


def test_a_full_disk_is_reported_before_anything_is_made(
    begin: Begin, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(environment_in(folder))
    monkeypatch.setattr(steps, "NEEDED_BYTES", {"cpu": 10**18})
    told = error_of(begin())
    assert worded("disk-full").search(told) and "Make room" in told and not list(folder.glob("engine-*"))


def test_a_folder_that_cannot_be_written_is_reported(code: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    told = error_of(RunningSetUp(SetUpRequest(), code, tmp_path / "file" / "plgs"))
    assert worded("set-up-stopped").search(told) and os.fspath(tmp_path / "file") in told


def test_the_command_says_why_it_ended(tmp_path: Path, root: Path) -> None:
    command = [sys.executable, root / "engine" / "__main__.py", "set-up", tmp_path / "plgs"]
    refused = subprocess.run([*command, "--base-python", "/nowhere/python"], capture_output=True, text=True)
    assert refused.returncode == 2 and worded("no-python").search(refused.stderr)
    made = tmp_path / "plgs" / "engine-3.11-abc"
    made.mkdir()
    (made / "pyvenv.cfg").touch()
    removed = subprocess.run([*command, "--remove"], capture_output=True, text=True)
    assert removed.returncode == 0 and "No environment is left" in removed.stdout and not made.exists()
