"""Locks of a lift between processes: while a holder lives, others are busy; after its end, the next has its turn."""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import pytest

from engine.errors import ErrorCode, ExitCode, PlgsError
from engine.job import BakeLocks, LiftState, lock
from engine.job.lock import FileLock, is_locked
from engine.job.system import OPEN_FILES_KEEP_NAMES
from tests.job.following import new_lift
from tests.raises_key import raises_key

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
HOLDER = """
import sys
from pathlib import Path
from engine.job.lock import FileLock
with FileLock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def holder(root: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the lock of the file "work"."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "work")]
    with subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


@posix
def test_a_suspended_process_keeps_its_lock(holder: subprocess.Popen[str], tmp_path: Path) -> None:
    holder.send_signal(signal.SIGSTOP)
    for wait_s in (0.0, 0.2):
        with pytest.raises(PlgsError) as refused, FileLock(tmp_path / "work", wait_s):
            pass
        assert refused.value.code is ErrorCode.BUSY and refused.value.exit_code is ExitCode.BUSY
    assert is_locked(tmp_path / "work")


@posix
def test_after_a_kill_only_one_waiting_process_gets_the_lock(holder: subprocess.Popen[str], tmp_path: Path) -> None:
    holder.kill()
    holder.wait()
    assert not is_locked(tmp_path / "work")
    held: list[int] = []

    def take(number: int) -> bool:
        try:
            with FileLock(tmp_path / "work", 0.2):
                held.append(number)
                assert held == [number], "two at once"
                time.sleep(0.4)
                held.remove(number)
        except PlgsError as error:
            assert error.code is ErrorCode.BUSY
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert any(list(pool.map(take, range(8))))


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_disk_without_file_locks_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Such as NFS 3 without lockd. Nothing is begun there."""
    lift = new_lift(tmp_path / "lift")
    lift.events_path.touch()
    monkeypatch.setattr(lock, "try_lock", Mock(side_effect=OSError(number, os.strerror(number))))
    for use in (lambda: lift.lock().__enter__(), lift.state, BakeLocks(lift.path).__enter__):
        with raises_key("no-file-locks") as refused:
            use()
        assert "NFS 4" in refused.value.fix and "\n" not in str(refused.value)


def test_a_locked_lift_runs_and_only_one_bake_claims_each_view(tmp_path: Path) -> None:
    lift = new_lift(tmp_path)
    with lift.lock():
        assert lift.state() is LiftState.RUNNING
        with pytest.raises(PlgsError), lift.lock():
            pass
    with BakeLocks(lift.path) as locks, BakeLocks(lift.path) as others:
        assert locks.others_at_work()
        with locks.claim("shot / 1") as first, others.claim("shot / 1") as second, locks.claim("shot / 1") as third:
            assert (first, second, third) == (True, False, False)
            with others.claim("shot / 2") as other:
                assert other
        with others.claim("shot / 1") as again:
            assert again
        assert OPEN_FILES_KEEP_NAMES or not list((lift.path / "bake").glob("view-*.lock")), "none is left behind"
    lift.discard()
    assert not lift.path.exists()
