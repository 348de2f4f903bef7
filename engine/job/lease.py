"""Leases: who works where on a disk that machines share, whose file system may not support locks across machines.

A lease is a file beside the one that it guards. Its holder writes a new beat into it every few seconds. A process that
wants it watches the beats by its own clock, so that the machines' clocks need not agree, and takes over the lease when
they have stopped for long.

The disk must guarantee, as NFS does, that a link to an existing name fails, that a rename is atomic, and that a file
that is opened again shows what another machine wrote before (close-to-open). No file system guarantees that a process
which was suspended for longer than STALE_S writes nothing before its next beat when it wakes. It then finds its lease
gone, and ends. All files of a lift are put in place by rename, and every process writes the same content. Files that
are read, changed and written go through `Lease.write`: whoever takes a lease first removes what its last holder was
about to put in place, so that a sleeper which wakes has nothing to rename.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import getnode, uuid4

from ..errors import ExitCode
from ..gates import create_plain, open_plain
from .atomic import PART, write_atomically
from .events import at_work
from .system import is_alive

VARIABLE = "PLGS_SHARED_DISK"
"""1: every disk counts as shared; 0: none. Otherwise Linux's mount table decides, and Windows' \\\\server\\share."""
BEAT_S = 5.0
"""Seconds between two of a holder's beats."""
STALE_S = 30.0
"""Seconds without a beat after which a lease is free."""
_SHARED_KINDS = frozenset(
    "nfs nfs4 cifs smb3 smbfs afs ceph lustre gpfs beegfs glusterfs panfs orangefs gfs2 ocfs2 9p fuse.glusterfs "
    "fuse.sshfs fuse.ceph fuse.juicefs fuse.s3fs".split()
)
_MOUNTS = Path("/proc/self/mounts")
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_LARGEST = 4096
_PROCESSES = Path("/proc/self/ns/pid")


@dataclass
class _Watched:
    """A holder's last beat, when this process's own clock first saw it, and whether another came before it."""

    holder: str
    beat: str
    since: float
    lives: bool = False


_watched: dict[Path, _Watched] = {}
"""The watched holders, by lease."""


def machine_id() -> str:
    """An id that differs between machines, between starts of a machine, and between containers."""
    try:
        return f"{platform.node()} {_BOOT_ID.read_text().strip()} {os.readlink(_PROCESSES)}"
    except OSError:
        return f"{platform.node()} {getnode():x}"


MACHINE = machine_id()


def is_on_shared_disk(path: Path) -> bool:
    """Whether other machines may work in the folder of ``path``."""
    said = os.environ.get(VARIABLE, "")
    return said == "1" if said in ("0", "1") else _is_shared(path.absolute().parent)


def _is_shared(folder: Path) -> bool:
    if os.name == "nt":
        return str(folder).startswith("\\\\")
    try:
        place = folder.resolve()
        place.exists()  # the check makes automount mount it
        mounts = [line.split() for line in _MOUNTS.read_text().splitlines()]
    except OSError:
        return False
    # Of two mounts at the same place the later one counts, such as nfs over autofs.
    under = [
        (len(point), number, kind)
        for number, (_, point, kind, *_) in enumerate(mounts)
        if place.is_relative_to(point.replace("\\040", " "))
    ]
    return bool(under) and max(under)[2] in _SHARED_KINDS


class Lease:
    """The right to work on a file on a shared disk, within a ``with`` block.

    With ``beats``, for the engine, a thread keeps it, and ends this process with `ExitCode.BUSY` if another process has
    taken it. Without, it is for work that takes less than STALE_S, such as Blender's. With a ``wait_s`` of 0 it never
    waits; otherwise a lease that a crash may have left is watched until it has a beat or is stale. Raises PlgsError if
    another process holds it, and OSError.
    """

    def __init__(self, path: Path, wait_s: float = 1.0, *, beats: bool = True) -> None:
        self._path, self._lease, self._wait_s, self._beats = path, lease_of(path), wait_s, beats
        self._id, self._descriptor, self._over = uuid4().hex, -1, threading.Event()

    def __enter__(self) -> Lease:
        began = time.monotonic()
        while not self._taken():
            state = _holder(self._lease)
            if state is None:
                continue
            if _is_stale(self._lease, state) and _take_away(self._lease, state["id"]):
                continue
            waited = time.monotonic() - began
            if not self._wait_s or (waited > self._wait_s and _watched[self._lease].lives):
                raise at_work(self._path)
            time.sleep(min(0.05, BEAT_S / 4))
        for part in self._lease.parent.glob(f"{PART}*-{self._lease.name}"):
            part.unlink(missing_ok=True)
        if self._beats:
            threading.Thread(target=self._beat, name="plgs-lease", daemon=True).start()
        return self

    def _taken(self) -> bool:
        if _created(self._lease, self._id):
            with suppress(FileNotFoundError):  # taken away already, as this process slept
                self._descriptor = os.open(self._lease, os.O_RDWR)
                if self._id.encode() in os.read(self._descriptor, _LARGEST):
                    return True
                os.close(self._descriptor)
        return False

    def write(self, path: Path, content: str) -> None:
        """Write a file that only holders write. Raises PlgsError if another has taken the lease over, and OSError."""
        part = self._lease.with_name(f"{PART}{self._id}-{self._lease.name}")
        write_atomically(path, content, part, self._refuse_lost)

    def _refuse_lost(self) -> None:
        if not self._is_ours():
            raise at_work(self._path)

    def _beat(self) -> None:
        beat = 0
        while not self._over.wait(BEAT_S):
            beat += 1
            with suppress(OSError):  # the server may not answer now; the next check shows whether the lease is lost
                os.lseek(self._descriptor, 0, os.SEEK_SET)
                os.write(self._descriptor, _content(self._id, beat))
                os.fsync(self._descriptor)
            with suppress(OSError):
                if not self._is_ours() and not self._over.is_set():
                    what = f"error: another machine took this over, as this one showed no sign of life: {self._path}"
                    print(what, file=sys.stderr, flush=True)
                    os._exit(ExitCode.BUSY)

    def _is_ours(self) -> bool:
        """Whether the lease is still ours. Raises OSError."""
        state = _holder(self._lease)
        return state is not None and state["id"] == self._id

    def __exit__(self, *_: object) -> None:
        self._over.set()
        with suppress(OSError):
            if self._is_ours():
                self._lease.unlink()
        os.close(self._descriptor)


def _content(holder: str, beat: int) -> bytes:
    """The content of a lease. A beat replaces as many digits in place: who reads meanwhile finds a lease, too."""
    about = {"id": holder, "machine": MACHINE, "pid": os.getpid(), "beat": f"{beat:012d}"}
    return json.dumps(about).encode().ljust(512) + b"\n"


def _created(path: Path, holder: str) -> bool:
    """Create the file with its content, and return whether this succeeded, as it can only once. Raises OSError."""
    part = path.with_name(f"{PART}{holder}.lease")
    try:
        with create_plain(part) as file:
            file.write(_content(holder, 0))
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(part, path)
        except FileExistsError:
            # If a server's answer was lost, it is asked again, and says that the name is taken: by this same file.
            return os.stat(part).st_nlink == 2
        except OSError:  # a file system without links
            with suppress(FileExistsError), open(path, "xb") as file:
                file.write(_content(holder, 0))
                return True
            return False
    finally:
        part.unlink(missing_ok=True)
    return True


def lease_of(path: Path) -> Path:
    """The lease's file."""
    return path.with_name(path.name + ".lease")


def is_leased(path: Path) -> bool:
    """Whether a process holds the lease of ``path``. A process whose machine may have crashed counts until this process
    has watched it for STALE_S. Raises OSError."""
    state = _holder(lease_of(path))
    return state is not None and not _is_stale(lease_of(path), state)


def may_have_crashed(path: Path) -> bool:
    """Whether the process that holds the lease of ``path`` has shown no sign of life since this process began to watch
    it. It will, or its lease becomes free. False on a disk that is not shared. Raises OSError.
    """
    if not is_on_shared_disk(path):
        return False
    lease = lease_of(path)
    state = _holder(lease)
    return state is not None and not _is_stale(lease, state) and not _watched[lease].lives


def _holder(lease: Path) -> dict[str, str] | None:
    """The content of a lease; None if there is no lease. Raises OSError."""
    try:
        with open_plain(lease, follow_link=False) as file:
            content = file.read(_LARGEST)
    except FileNotFoundError:
        return None
    try:
        told = json.loads(content)
        return {name: str(told[name]) for name in ("id", "machine", "pid", "beat")}
    except (ValueError, KeyError, TypeError):  # written by something else, or incomplete after a power cut
        return {"id": content.hex(), "machine": "", "pid": "0", "beat": ""}


def _is_stale(lease: Path, state: dict[str, str]) -> bool:
    seen = _watched.get(lease)
    if seen is None or seen.holder != state["id"]:
        seen = _watched[lease] = _Watched(state["id"], state["beat"], time.monotonic())
    if seen.beat != state["beat"]:
        seen.beat, seen.since, seen.lives = state["beat"], time.monotonic(), True
    if state["machine"] == MACHINE and state["pid"].isdecimal():
        seen.lives = is_alive(int(state["pid"]))
        if not seen.lives:
            return True
    return time.monotonic() - seen.since > STALE_S


def _take_away(lease: Path, stale: str) -> bool:
    """Remove a stale lease, unless another process is doing so. Only one at a time does, so that none removes a lease
    that another has taken since. Returns whether it is gone. Raises OSError."""
    guard, own = lease.with_name(f"{PART}{lease.name}.stale"), uuid4().hex
    if not _created(guard, own):
        guarded = _holder(guard)
        if guarded is None or not _is_stale(guard, guarded):
            return False
        _remove(guard, guarded["id"])  # left by a crash
        if not _created(guard, own):
            return False
    try:
        _remove(lease, stale)
    finally:
        _remove(guard, own)
    return True


def _remove(path: Path, holder: str) -> None:
    """Remove a file if it belongs to this holder. Raises OSError."""
    state = _holder(path)
    if state is not None and state["id"] == holder:
        path.unlink(missing_ok=True)
