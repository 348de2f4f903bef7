"""Setting the engine up with a real uv from an index on this machine: to the end, cut off, and gone on with."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from engine.job import EventWriter, StopSignal
from engine.job.environment import is_complete, python_in, requirement_file
from engine.set_up import SetUpRequest, remove_environments, steps, uv_program
from tests.raises_key import raises_key, worded
from tests.set_up.package_index import PackageIndex, installed, wheel
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


def uvs_of(folder: Path) -> list[int]:
    """The running programs of the folder's uv."""
    found = []
    for process in (each for each in Path("/proc").iterdir() if each.name.isdigit()):
        with suppress(OSError):
            if (process / "cmdline").read_bytes().startswith(f"{folder}/uv-".encode()) and lives(int(process.name)):
                found.append(int(process.name))
    return found


def test_a_set_up_makes_an_engine_that_answers(folder: Path, begin: Begin, index: PackageIndex) -> None:
    running = begin().wait()
    assert running.error is None and is_complete(environment_in(folder))
    assert running.python == python_in(environment_in(folder))
    assert set(index.downloads) == set(index.wheels)
    assert running.fractions == sorted(running.fractions) and running.fractions[-1] == 5 / 6
    begun = [label.partition(":")[0] for label in running.labels]
    assert list(dict.fromkeys(begun)) == list(steps.LABELS)
    assert any("Writing" in label for label in running.labels)
    log = running.set_up.log_path.read_text()
    assert "compiled for" in log and "os, 'sync'" in log, "the packages are synced before the environment counts"
    kept = {environment_in(folder).name, "set-up.log", "set-up.lock", f"uv-{uv_program.VERSION}"}
    assert {path.name for path in folder.iterdir()} == kept
    index.downloads.clear()
    assert begin().wait().python == running.python and index.downloads == []
    (folder / "engine-mine").mkdir()  # no environment
    remove_environments(folder)
    assert {path.name for path in folder.iterdir()} == {"engine-mine", "set-up.log", "set-up.lock"}


def test_an_interrupted_download_is_reported_and_continued(begin: Begin, index: PackageIndex, folder: Path) -> None:
    index.fault["numba"] = "cut"
    told = error_of(begin())
    assert worded("uv-failed").search(told) and "set-up.log" in told
    (environment_in(folder) / "half").touch()
    index.fault.clear()
    index.downloads.clear()
    assert begin().wait().python is not None
    assert "numba" in index.downloads and "torch" not in index.downloads and not list(folder.glob("*/half"))


def test_a_wheel_with_another_hash_is_refused(begin: Begin, index: PackageIndex) -> None:
    name, _ = index.wheels["numba"]
    index.wheels["numba"] = name, wheel("numba", name.split("-")[1], "other")[1]
    told = error_of(begin())
    assert worded("uv-failed").search(told) and "numba" in told and "\n" not in told


def test_downloaded_wheels_set_up_a_computer_without_a_network(
    folder: Path, code: Path, index: PackageIndex, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pip collects tiny wheels; uv installs them while no index answers, and refuses a wheel that was changed."""
    index.wheels |= {"pip": installed("pip"), "uv": wheel("uv", uv_program.VERSION, "uv")}
    digests = {name: hashlib.sha256(index.wheels[name][1]).hexdigest() for name in ("pip", "uv")}
    version = index.wheels["pip"][0].split("-")[1]
    (code / "requirements/pip.txt").write_text(f"pip=={version} --hash=sha256:{digests['pip']}\n")
    monkeypatch.setattr(uv_program, "pinned_wheel", lambda: (index.wheels["uv"][0], digests["uv"]))
    monkeypatch.setattr(steps, "ADDED", ("usd",))  # which the index lacks
    wheels = tmp_path / "wheels"
    collecting = RunningSetUp(SetUpRequest(None, "cpu", index.url, download=wheels), code, folder).wait()
    assert collecting.error is None and not list(folder.glob("engine-*"))
    found = {path.name for path in wheels.glob("*.whl")}
    assert found == {name for package, (name, _) in index.wheels.items() if package != "pip"}
    (listed,) = wheels.glob("torch-cpu-*.txt")
    index.downloads.clear()

    offline = SetUpRequest(None, "cpu", "http://127.0.0.1:9/simple", wheels)
    made = RunningSetUp(offline, code, folder).wait()
    assert made.error is None and is_complete(environment_in(folder)) and index.downloads == []
    for package in ("torch", "scipy"):
        shutil.rmtree(environment_in(folder))
        name, content = index.wheels[package]
        (wheels / name).write_bytes(wheel(package, name.split("-")[1], "other")[1])
        told = error_of(RunningSetUp(offline, code, folder))
        assert worded("uv-failed").search(told) and package in told
        (wheels / name).write_bytes(content)
    text = listed.read_text()
    other, lines = wheel("torch", "99.9", "other"), requirement_file(code, "hashes-torch")
    (wheels / other[0]).write_bytes(other[1])
    other_line = f"torch==99.9 --hash=sha256:{hashlib.sha256(other[1]).hexdigest()}"
    for line in (other_line, f"{text}torch @ https://a/b.whl", f"{text}-e ."):
        listed.write_text(f"{line}\n")
        with raises_key("foreign-wheel --torch-hash"):
            raise RunningSetUp(offline, code, folder).wait().error or AssertionError
    listed.write_text(text)
    digest = lines.read_text().rpartition(":")[2].strip()
    lines.write_text("")  # a build whose hash is not pinned
    assert worded("foreign-wheel").search(error_of(RunningSetUp(offline, code, folder)))
    assert RunningSetUp(replace(offline, torch_hash=digest), code, folder).wait().error is None
    shutil.rmtree(environment_in(folder))
    listed.unlink()
    with raises_key("no-wheels"):
        raise RunningSetUp(offline, code, folder).wait().error or AssertionError


def test_an_index_password_stays_out_of_log_and_messages(begin: Begin, index: PackageIndex) -> None:
    index.fault["scipy"] = "garbage"
    running = begin(url=index.url.replace("http://", "http://me:secret@"))
    assert "secret" not in error_of(running) and not any("secret" in label for label in running.labels)
    log = running.set_up.log_path.read_text()
    assert " pip install" in log and "secret" not in log


def test_cancelling_a_set_up_ends_uv_at_once(begin: Begin, index: PackageIndex, folder: Path) -> None:
    index.fault["torch"] = "stall"
    running = begin().wait(until=index.stalled.is_set)
    assert uvs_of(folder)
    running.cancel()
    assert not uvs_of(folder)
    assert running.python is None and running.error is None
    index.fault.clear()
    again = begin()  # the lock is free
    again.wait(until=lambda: any("Installing torch" in label for label in again.labels))


@pytest.mark.slow
def test_the_next_set_up_waits_for_uv_of_a_killed_one(
    begin: Begin, index: PackageIndex, folder: Path, code: Path, root: Path, tmp_path: Path
) -> None:
    """Two set-ups and a kill: the uv of the killed one holds the lock on, the other goes on after it."""
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
    assert "Another set-up" in second.label and len(uvs_of(folder)) == 1
    index.fault.clear()
    index.go_on.set()
    assert second.wait().python is not None


@pytest.mark.parametrize("mark", ["3.11.9 cpu\n", "3.11.9 cuda\n"])
def test_a_set_up_replaces_an_unfit_environment(begin: Begin, folder: Path, mark: str) -> None:
    begin().wait()
    environment = environment_in(folder)
    (environment / "complete").write_text(mark)
    if "cpu" in mark:
        shutil.rmtree(next(environment.glob("lib/python*/site-packages/torch")))
    (environment / "old").touch()
    assert begin().wait().python is not None and not (environment / "old").exists()


@pytest.mark.parametrize(
    ("answer", "told"), [("exit 1", "failed with exit status"), ("echo hello", "invalid response")]
)
def test_a_set_up_reports_an_unusable_python(begin: Begin, tmp_path: Path, answer: str, told: str) -> None:
    python = tmp_path / "none"
    python.write_text(f"#!/bin/sh\n{answer}\n")
    python.chmod(0o755)
    error = error_of(begin(base=str(python)))
    assert worded("no-python").search(error) and told in error


def test_a_set_up_reports_a_full_disk_at_once(begin: Begin, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "NEEDED_BYTES", {"cpu": 10**18})
    told = error_of(begin())
    assert worded("disk-full").search(told) and "Make room" in told and not list(folder.glob("engine-*"))


def test_a_diverted_uv_is_refused(begin: Begin, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "uv.toml").write_text('pip = {target = "/somewhere/else"}')
    monkeypatch.setenv("UV_CONFIG_FILE", str(tmp_path / "uv.toml"))
    assert worded("uv-settings").search(error_of(begin())) and not list(folder.glob("*engine*"))


def test_a_set_up_reports_a_folder_that_cannot_be_written(code: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    told = error_of(RunningSetUp(SetUpRequest(), code, tmp_path / "file" / "plgs"))
    assert worded("set-up-stopped").search(told) and os.fspath(tmp_path / "file") in told


def test_engine_set_up_says_why_it_failed(tmp_path: Path, root: Path) -> None:
    command = [sys.executable, root / "engine" / "__main__.py", "set-up", tmp_path / "plgs"]
    refused = subprocess.run([*command, "--base-python", "/nowhere/python"], capture_output=True, text=True)
    assert refused.returncode == 2 and worded("no-python").search(refused.stderr)
    made = tmp_path / "plgs" / "engine-3.11-abc"
    made.mkdir()
    (made / "pyvenv.cfg").touch()
    removed = subprocess.run([*command, "--remove"], capture_output=True, text=True)
    assert removed.returncode == 0 and "No environment is left" in removed.stdout and not made.exists()


def test_a_set_up_keeps_a_folder_with_files_of_others(tmp_path: Path) -> None:
    """On macOS and Windows, a home has such a folder."""
    film = tmp_path / "home/Downloads/film.mp4"
    film.parent.mkdir(parents=True)
    film.write_text("mine")
    (tmp_path / "home/python").mkdir()
    events = EventWriter(tmp_path / "events.jsonl")
    for act in (
        lambda: steps.SetUp(SetUpRequest(), events, StopSignal(), folder=tmp_path / "home").run(),
        lambda: remove_environments(tmp_path / "home"),
    ):
        with raises_key("folder-used"):
            act()
    assert film.read_text() == "mine" and (tmp_path / "home/python").is_dir()
    assert sorted(path.name for path in (tmp_path / "home").iterdir()) == ["Downloads", "python"]
