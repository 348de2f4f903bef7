"""Setting the engine up with a real pip from an index on this machine: to the end, cut off, and gone on with."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from following import follow
from package_index import PackageIndex, wheel
from plgs.engine.job.environment import is_complete, python_in
from plgs.plgs_blender.engine_environment import pip
from plgs.plgs_blender.engine_environment import set_up as steps
from plgs.plgs_blender.engine_environment.notes import Notes
from plgs.plgs_blender.engine_environment.progress import Outcome, Wish
from plgs.plgs_blender.engine_environment.set_up import SetUp

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals and links")
Begin = Callable[..., SetUp]


def environment_in(folder: Path) -> Path:
    return next(folder.glob("engine-*"))


def error_of(outcome: Outcome | None) -> str:
    assert outcome is not None and outcome.error is not None, outcome
    return str(outcome.error)


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
    set_up = begin()
    seen, polls_s = [], []
    while set_up.outcome is None:
        began = time.thread_time()  # not the time of the clock: others may be busy
        set_up.poll()
        polls_s.append(time.thread_time() - began)
        seen.append(set_up.progress)
        time.sleep(0.02)
    outcome = set_up.outcome
    assert outcome.error is None and max(polls_s) < 0.05  # what Blender's window may be kept waiting
    assert outcome.python == python_in(environment_in(folder)) and is_complete(environment_in(folder))
    assert sorted(index.downloads) == sorted(index.wheels)
    fractions = [progress.fraction for progress in seen]
    assert fractions == sorted(fractions) and fractions[-1] >= 0.98
    assert sorted({progress.step for progress in seen}) == [1, 3, 4, 5, 6]  # 2 was done before
    assert any("Writing" in progress.detail for progress in seen) and seen[-1].bytes_on_disk > 1_000_000
    assert "compiled for" in set_up.log_path.read_text()
    assert {path.name for path in folder.iterdir()} == {environment_in(folder).name, "set-up.log", "set-up.lock"}
    index.downloads.clear()
    assert follow(begin()) == outcome and index.downloads == []


def test_a_download_that_breaks_off_is_told_and_gone_on_with(begin: Begin, index: PackageIndex, folder: Path) -> None:
    index.fault["numba"] = "cut"
    told = error_of(follow(begin()))
    assert "pip could not install packages" in told and "goes on there" in told and "set-up.log" in told
    notes = Notes.read(environment_in(folder))
    assert notes is not None and notes.done == ["torch"] and not is_complete(environment_in(folder))
    index.fault.clear()
    outcome = follow(begin())
    assert outcome is not None and outcome.python is not None
    assert index.downloads.count("torch") == 1


def test_a_broken_wheel_is_told(begin: Begin, index: PackageIndex) -> None:
    index.fault["torch"] = "garbage"
    told = error_of(follow(begin()))
    assert "pip could not install torch" in told and "wheel" in told.lower()


def test_a_wheel_that_was_exchanged_is_refused(begin: Begin, index: PackageIndex) -> None:
    name, _ = index.wheels["numba"]
    index.wheels["numba"] = name, wheel("numba", name.split("-")[1], "other")[1]
    assert "DO NOT MATCH THE HASHES" in error_of(follow(begin()))


def test_the_password_of_an_index_stays_out_of_log_and_message(
    code: Path, folder: Path, index: PackageIndex, capfd: pytest.CaptureFixture[str]
) -> None:
    index.fault["scipy"] = "garbage"
    url = index.url.replace("http://", "http://me:secret@")
    set_up = SetUp(Wish(Path(sys.executable), "cpu", url), code, folder)
    assert "secret" not in error_of(follow(set_up))
    log = set_up.log_path.read_text()
    assert "pip install" in log and "secret" not in log


def test_the_users_hash_policy_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PIP_REQUIRE_HASHES", "1")
    assert pip.environment(tmp_path)["PIP_REQUIRE_HASHES"] == "1"


def test_what_pip_wrote_is_synced_before_it_counts_as_complete(begin: Begin, folder: Path) -> None:
    set_up = begin()
    while set_up.outcome is None:
        set_up.poll()
        if is_complete(environment_in(folder)):
            assert "os, 'sync'" in set_up.log_path.read_text()
        time.sleep(0.02)
    assert set_up.outcome.error is None


def test_cancel_ends_pip_at_once(begin: Begin, index: PackageIndex, folder: Path) -> None:
    index.fault["torch"] = "stall"
    set_up = begin()
    assert follow(set_up, until=index.stalled.is_set) is None
    follow(set_up, until=lambda: "Downloading torch" in set_up.progress.detail)
    assert pips_of(folder)
    set_up.cancel()
    assert not pips_of(folder)
    assert set_up.outcome == Outcome()
    index.fault.clear()
    again = begin()  # the lock is free
    follow(again, until=lambda: again.progress.step == 3)


@pytest.mark.slow
def test_after_a_kill_the_next_one_waits_for_the_pip_that_is_left(
    begin: Begin, index: PackageIndex, folder: Path, code: Path, root: Path
) -> None:
    """Two Blenders and a kill: the pip of the killed one holds the lock on, the other goes on after it."""
    index.fault["torch"] = "stall"
    script = f"""
import sys; sys.path.insert(0, {str(root / "tests")!r})
import conftest, time
from pathlib import Path
from plgs.plgs_blender.engine_environment.progress import Wish
from plgs.plgs_blender.engine_environment.set_up import SetUp
set_up = SetUp(Wish(Path(sys.executable), "cpu", {index.url!r}), Path({str(code)!r}), Path({str(folder)!r}))
while True:
    set_up.poll(); time.sleep(0.02)
"""
    first = subprocess.Popen([sys.executable, "-c", script])
    try:
        assert index.stalled.wait(30)
        second = begin()
        follow(second, until=lambda: second.progress.label == "Waiting")
    finally:
        first.send_signal(signal.SIGKILL)
        first.wait()
    for _ in range(10):
        second.poll()
        time.sleep(0.02)
    assert second.progress.label == "Waiting" and len(pips_of(folder)) == 1
    index.fault.clear()
    index.go_on.set()
    outcome = follow(second)
    assert outcome is not None and outcome.python is not None, outcome


def test_what_may_be_half_written_is_made_anew(begin: Begin, folder: Path) -> None:
    """Killed while pip wrote packages, or made with another torch: moved aside at once, deleted later."""
    environment = environment_in(folder)
    for notes, build in ((Notes("cpu", ["torch"], installing=True), "cpu"), (Notes("cpu", ["torch"]), "cuda")):
        environment.mkdir(exist_ok=True)
        notes.write(environment)
        (environment / "half").touch()
        set_up = begin(build=build)
        follow(set_up, until=lambda: not (environment / "half").exists(), patience_s=20)
        assert set_up.outcome is None
        set_up.cancel()
    assert [path.name for path in sorted(folder.glob("trash-*"))] == ["trash-0", "trash-1"]


def test_a_complete_environment_that_does_not_answer_is_made_anew(begin: Begin, folder: Path) -> None:
    environment = environment_in(folder)
    (environment / "complete").touch()  # but nothing is installed
    (environment / "old").touch()
    follow(begin(), until=lambda: not (environment / "old").exists(), patience_s=20)


def test_where_no_python_can_make_environments_says_why(begin: Begin, tmp_path: Path) -> None:
    debian = '[[3, 11], "/usr/bin/python3.11", ["ensurepip"]]'
    for words, told in (
        (f"echo '{debian}'", "lacks ensurepip (on Debian and Ubuntu: python3.11-venv)"),
        ("echo '[[3, 99], \"/p\", []]'", "is Python 3.99, which the packages are not pinned for"),
        ("exit 1", "does not work as a Python"),
        ("echo hello", "does not work as a Python"),
    ):
        python = tmp_path / "python"
        python.write_text(f"#!/bin/sh\n{words}\n")
        python.chmod(0o755)
        error = error_of(follow(begin(base=str(python))))
        assert told in error and "Install Python 3.11 or 3.13" in error
    assert "cannot be run" in error_of(follow(begin(base=str(tmp_path / "none"))))


def test_a_full_disk_is_told_before_anything_is_made(
    begin: Begin, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(environment_in(folder))
    monkeypatch.setattr(steps, "NEEDED_BYTES", {"cpu": 10**18})
    told = error_of(follow(begin()))
    assert "GB free" in told and "Make room" in told and not list(folder.glob("engine-*"))


def test_a_folder_that_cannot_be_written_is_told(code: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    told = error_of(follow(SetUp(Wish(), code, tmp_path / "file" / "plgs")))
    assert "the set-up stopped" in told and os.fspath(tmp_path / "file") in told
