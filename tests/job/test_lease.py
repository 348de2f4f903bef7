"""Leases, between real processes with lock tables of their own: what one locks, the other does not see."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from engine.errors import ErrorCode, ExitCode, PlgsError
from engine.job import BakeLocks, LiftState, lease, session
from engine.job.lease import Lease, is_leased, is_on_shared_disk, lease_of, may_have_crashed
from tests.job.lift_folders import new_lift
from tests.waiting import PATIENCE_S, wait_until

BEAT_S, STALE_S = 0.1, 30.0
"""Of holders and of those who look, whose clocks tests turn on (`Clock`): none is stale on a machine that halts."""
HOLDER = f"""
import sys, time
from pathlib import Path
from engine.job import lease
real = time.time
time.time = lambda: real() + 3600.0  # a clock an hour ahead
lease.MACHINE, lease.BEAT_S = sys.argv[2], {BEAT_S}
with lease.Lease(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""
Hold = Callable[..., subprocess.Popen[str]]


class Clock:
    """The module's clock, as this process has it. ``in_naps``: what a nap of the module's takes of it, seconds."""

    def __init__(self) -> None:
        self.ahead = self.in_naps = 0.0
        self.naps, self.time = 0, time.time

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)
        self.ahead += self.in_naps
        self.naps += 1


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(lease, "time", clock)
    monkeypatch.setattr(lease, "BEAT_S", BEAT_S)
    monkeypatch.setattr(lease, "STALE_S", STALE_S)
    monkeypatch.setenv(lease.VARIABLE, "1")
    return clock


def next_beat(work: Path) -> None:
    """Wait until the holder's lease has another beat."""
    before = lease_of(work).read_bytes()
    wait_until(lambda: lease_of(work).read_bytes() != before, work)


@pytest.fixture
def hold(root: Path, tmp_path: Path) -> Iterator[Hold]:
    """Start a process that holds the lease of a file, on another machine unless said otherwise."""
    started: list[subprocess.Popen[str]] = []

    def start(machine: str = "another") -> subprocess.Popen[str]:
        command = [sys.executable, "-c", HOLDER, str(tmp_path / "work"), machine]
        process = subprocess.Popen(
            command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_heartbeat_keeps_the_lease(hold: Hold, tmp_path: Path, clock: Clock) -> None:
    holder = hold()
    for wait_s in (0.0, 0.2):
        with pytest.raises(PlgsError) as refused, Lease(tmp_path / "work", wait_s):
            pass
        assert refused.value.code is ErrorCode.BUSY
    for _ in range(3):
        clock.ahead += 0.9 * STALE_S
        next_beat(tmp_path / "work")
        assert is_leased(tmp_path / "work")
    holder.communicate("\n", timeout=PATIENCE_S)
    assert not is_leased(tmp_path / "work") and not lease_of(tmp_path / "work").exists()
    with Lease(tmp_path / "work"):
        pass


def test_after_a_kill_on_another_machine_it_is_taken_over_when_it_is_stale(
    hold: Hold, tmp_path: Path, clock: Clock
) -> None:
    hold().kill()
    began, clock.in_naps = clock.monotonic(), 0.1 * STALE_S
    assert is_leased(tmp_path / "work")  # nothing shows yet that its holder is gone
    with Lease(tmp_path / "work"):
        assert STALE_S < clock.monotonic() - began < 1.5 * STALE_S
    assert [*tmp_path.iterdir()] == []


def test_a_lift_is_resumed_after_its_machine_crashed(
    hold: Hold, tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "_ENDING_S", 0.1)
    monkeypatch.setattr(session, "time", clock)
    lift = new_lift(tmp_path / "lift")
    holder = hold()
    holder.kill()
    holder.wait()
    lease_of(tmp_path / "work").rename(lease_of(lift.events_path))
    assert session.may_have_crashed(lift.events_path)
    clock.in_naps = 0.1 * STALE_S
    assert session._state_when_left_alone(lift) is LiftState.NOT_STARTED


def test_a_lift_whose_machine_lives_is_busy_at_once(hold: Hold, tmp_path: Path) -> None:
    hold()
    work = tmp_path / "work"
    assert may_have_crashed(work)
    next_beat(work)
    assert is_leased(work) and not may_have_crashed(work)


def test_the_later_of_two_mounts_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(lease.VARIABLE)
    monkeypatch.setattr(lease, "_MOUNTS", tmp_path / "mounts")
    lines = ["/dev/a / ext4 rw 0 0", f"auto {tmp_path} autofs rw 0 0", f"server:/x {tmp_path} nfs4 rw 0 0"]
    (tmp_path / "mounts").write_text("\n".join(lines[:2]))
    assert not is_on_shared_disk(tmp_path / "lift")
    (tmp_path / "mounts").write_text("\n".join(lines))
    assert is_on_shared_disk(tmp_path / "lift")


def test_after_a_kill_on_this_machine_it_is_taken_over_at_once(hold: Hold, tmp_path: Path) -> None:
    holder = hold(lease.MACHINE)
    holder.kill()
    holder.wait()
    assert not is_leased(tmp_path / "work")
    with Lease(tmp_path / "work", 0.0):
        pass


def test_a_suspended_engine_ends_when_it_wakes(hold: Hold, tmp_path: Path, clock: Clock) -> None:
    holder = hold()
    holder.send_signal(signal.SIGSTOP)
    clock.in_naps = 0.1 * STALE_S
    with Lease(tmp_path / "work"):
        holder.send_signal(signal.SIGCONT)
        assert holder.wait(PATIENCE_S) == ExitCode.BUSY
        assert is_leased(tmp_path / "work") and str(os.getpid()) in lease_of(tmp_path / "work").read_text()
    assert "another machine took this over" in holder.communicate()[1]


def test_only_one_of_many_gets_a_stale_lease(hold: Hold, tmp_path: Path) -> None:
    holder = hold(lease.MACHINE)  # stale at once, as its process is dead
    holder.kill()
    holder.wait()
    held: list[int] = []

    def take(number: int) -> bool:
        try:
            with Lease(tmp_path / "work", 0.2):
                held.append(number)
                assert held == [number], "two at once"
                time.sleep(4 * BEAT_S)
                held.remove(number)
        except PlgsError as error:
            assert error.code is ErrorCode.BUSY
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert any(list(pool.map(take, range(8))))


def test_only_one_process_removes_a_stale_lease(hold: Hold, tmp_path: Path, clock: Clock) -> None:
    """Else the second would take away what the first has just taken. A guard that a crash left goes, too."""
    holder = hold(lease.MACHINE)
    holder.kill()
    holder.wait()
    stale = lease_of(tmp_path / "work")
    left = stale.read_bytes()
    guard = tmp_path / f".part-{stale.name}.stale"
    guard.write_bytes(lease._content("another thread", 0))
    with pytest.raises(PlgsError, match="at work"), Lease(tmp_path / "work", 0.0):
        pass
    assert clock.naps == 0 and stale.read_bytes() == left and guard.exists()
    guard.write_bytes(left)
    with Lease(tmp_path / "work", 0.0):
        assert not guard.exists() and stale.read_bytes() != left
    assert [*tmp_path.iterdir()] == []


def test_what_is_not_a_lease_is_taken_over_too(tmp_path: Path, clock: Clock) -> None:
    clock.in_naps = 0.1 * STALE_S
    lease_of(tmp_path / "work").write_text("cut o")
    with Lease(tmp_path / "work"):
        pass


def test_a_lease_that_is_read_while_it_beats_is_one(tmp_path: Path, clock: Clock) -> None:
    """The disk may have the beginning of the new content when it still has the end of the old one."""
    beats = []
    for number, now in enumerate((1.7e9 + 0.5, 1.7e9 + 7.0123456)):
        clock.time = lambda now=now: now  # type: ignore[misc]
        beats.append(lease._content("ours", number))
    for written in range(len(beats[0].rstrip())):
        lease_of(tmp_path / "work").write_bytes(beats[1][:written] + beats[0][written:])
        read = lease._holder(lease_of(tmp_path / "work"))
        assert read is not None and read["id"] == "ours", written


def test_leases_work_without_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    with Lease(tmp_path / "work"), pytest.raises(PlgsError), Lease(tmp_path / "work", 0.0):
        pass


def test_a_lift_on_a_shared_disk_has_leases(tmp_path: Path) -> None:
    lift = new_lift(tmp_path)
    with lift.lock():
        assert lift.state() is LiftState.RUNNING and lease_of(lift.events_path).exists()
        with pytest.raises(PlgsError), lift.lock():
            pass
    with BakeLocks(lift.path) as locks, BakeLocks(lift.path) as others:
        assert locks.others_at_work()
        with locks.claim("a") as ours, others.claim("a") as theirs:
            assert (ours, theirs) == (True, False)
    assert not [*lift.path.rglob("*.lease")]
    lift.discard()
    assert not lift.path.exists()


def test_which_disks_are_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(lease.VARIABLE, "0")
    assert not is_on_shared_disk(tmp_path / "work")
    monkeypatch.delenv(lease.VARIABLE)
    table = tmp_path / "mounts"
    table.write_text(f"disk / ext4 rw 0 0\nserver:/farm {tmp_path}/the\\040farm nfs4 rw 0 0\n")
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path: read(table if str(path) == "/proc/self/mounts" else path))
    assert is_on_shared_disk(tmp_path / "the farm" / "lift" / "work")
    assert not is_on_shared_disk(tmp_path / "lift" / "work")
