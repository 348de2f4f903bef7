"""A file system that fails at the n-th call, as SQLite tests with, or that forgets what was not synced.

`Faults` lets a call fail, once or from then on; then all heals. `Recorder` records what happens, and `after_power_cuts`
plays it again, less what no fsync had made lasting: a file's bytes last from the fsync of the file on, a name from the
fsync of its folder on. Of the rest anything may be lost: names of one folder from the last one back, those of different
folders and bytes in any order.
"""

import copy
import errno
import fcntl
import io
import os
import random
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ERRORS = (errno.ENOSPC, errno.EIO, errno.ESTALE, errno.EROFS)
SHORT = 0
"""In place of an error: a write that takes half of what it was given, and then finds the disk full."""
CHANGES = ("open", "write", "fsync", "replace", "rename", "link", "unlink", "mkdir", "rmdir", "ftruncate")
CALLS = (*CHANGES, "stat", "lstat", "fstat", "scandir", "listdir")
Call = Callable[..., Any]
Nodes = dict[int, bytes | dict[str, int]]
"""By number: a file's bytes, or the numbers of what a folder holds. 0 is the folder that is watched."""


class _Watched:
    """Calls of `os` for what lies below ``folder``, and Python's files, whose writes then go through `os.write`."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self._patch = folder, patch

    @contextmanager
    def _watching(self, calls: tuple[str, ...]) -> Iterator[None]:
        """Calls go through ``self._call``, the opening of files through ``self._opened``, which gives what to open."""
        with self._patch.context() as patch:
            for name in calls:
                patch.setattr(os, name, self._wrapped(name, getattr(os, name)))
            for module, name in ((io, "open"), (os, "fdopen")):
                patch.setattr(module, name, self._opening(getattr(module, name)))
            yield

    def _wrapped(self, name: str, call: Call) -> Call:
        return lambda *args, **options: self._call(name, call, *args, **options)

    def _opening(self, opening: Call) -> Call:
        def opened(file: Any, mode: str = "r", *rest: Any, **options: Any) -> Any:
            file = self._opened(file, mode)
            if "r" in mode or "opener" in options or self._path(file) is None:
                return opening(file, mode, *rest, **options)
            raw = io.BufferedWriter(_Raw(file, mode.replace("t", "").replace("b", "")))
            return raw if "b" in mode else io.TextIOWrapper(raw, options.get("encoding"), write_through=True)

        return opened

    def _path(self, where: Any) -> tuple[str, ...] | None:
        """The names below the folder that lead to a path or descriptor; None elsewhere."""
        try:
            path = os.readlink(f"/proc/self/fd/{where}") if isinstance(where, int) else os.fspath(where)
        except OSError:
            return None
        if not isinstance(path, str) or not path.startswith(str(self.folder)):
            return None
        return Path(path).relative_to(self.folder).parts


class _Raw(io.FileIO):
    def write(self, data: Any) -> int:
        return os.write(self.fileno(), bytes(data))


class Faults(_Watched):
    """Counts the calls below ``folder`` inside `failing`, in this thread or, ``everywhere``, in the whole process."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch, everywhere: bool = False) -> None:
        super().__init__(folder, patch)
        self.calls: list[tuple[str, str]] = []
        """The kind and the file of each."""
        self.failed: list[str] = []
        """What failed, as "fsync manifest.json"."""
        self._thread = None if everywhere else threading.get_ident()
        self._at, self._error, self._for_good = 0, SHORT, False
        self._is_asleep = False

    @contextmanager
    def failing(self, at: int, error: int, for_good: bool = False, calls: tuple[str, ...] = CALLS) -> Iterator[None]:
        """Let the call number ``at`` (from 1) fail with ``error``, and with ``for_good`` all that follow."""
        self.calls, self._at, self._error, self._for_good, self.failed = [], at, error, for_good, []
        with self._watching(calls), self._patch.context() as patch:
            patch.setattr(fcntl, "flock", self._wrapped("lock", fcntl.flock))
            yield

    @contextmanager
    def asleep(self) -> Iterator[None]:
        """What happens inside is another process's doing: it neither counts nor fails."""
        self._is_asleep = True
        try:
            yield
        finally:
            self._is_asleep = False

    @property
    def has_failed(self) -> bool:
        return bool(self.failed)

    def tick(self, call: str, where: Any) -> None:
        """Raises OSError when it is this call's turn to fail."""
        path = self._path(where)
        if path is None or self._is_asleep or self._thread not in (None, threading.get_ident()):
            return
        self.calls.append((call, "/".join(path)))
        if len(self.calls) == self._at or (self._for_good and len(self.calls) > self._at):
            self.failed.append(f"{call} {path[-1] if path else self.folder.name}")
            number = self._error or errno.ENOSPC
            raise OSError(number, os.strerror(number), str(self.folder.joinpath(*path)))

    def _call(self, name: str, call: Call, *args: Any, **options: Any) -> Any:
        if name == "write" and self._error == SHORT and len(self.calls) + 1 == self._at and len(args[1]) > 1:
            if self._path(args[0]) is not None:
                self.calls.append((name, "half of it"))
                self._at += 1  # the rest finds no room
                return call(args[0], args[1][: len(args[1]) // 2])
        if name == "fsync":
            return self.tick(name, args[0])  # nobody waits for the disk here
        if args and not options.get("dir_fd"):
            self.tick(name, args[0])
        return call(*args, **options)

    def _opened(self, file: Any, mode: str) -> Any:
        if not isinstance(file, int):
            self.tick("open", file)
        return file


def every_fault(faults: Faults, thoroughly: bool) -> Iterator[tuple[int, int, bool]]:
    """Yields ``at``, ``error``, ``for_good`` until a round passes without a fault; ``thoroughly`` with each kind of
    error."""
    at, kinds = 0, (*ERRORS, SHORT)
    while at == 0 or faults.has_failed or len(faults.calls) >= at:
        at += 1
        for error in kinds if thoroughly else (kinds[at % len(kinds)],):
            yield at, error, False
            yield at, error, True


class Bytes(NamedTuple):
    """A file's whole content from then on."""

    node: int
    content: bytes


class Name(NamedTuple):
    """A name that a folder has from then on, or (without ``target``) has no more; by a rename ``old`` goes with it."""

    node: int
    name: str
    target: int | None
    old: str | None = None


class Sync(NamedTuple):
    node: int


class Recorder(_Watched):
    """Records what happens below ``folder``, inside `recording`."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        super().__init__(folder, patch)
        self._nodes: Nodes = {}
        self._read(folder)
        self.before = copy.deepcopy(self._nodes)
        self.kinds: dict[int, type] = {}
        self.changes: list[Bytes | Name | Sync] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        with self._watching(CHANGES):
            yield

    def _read(self, path: Path) -> int:
        number = len(self._nodes)
        self._nodes[number] = b""
        is_file = path.is_file()
        self._nodes[number] = path.read_bytes() if is_file else {each.name: self._read(each) for each in path.iterdir()}
        return number

    def _call(self, name: str, call: Call, first: Any, *args: Any, **options: Any) -> Any:
        where = first
        if options.get("dir_fd") is not None:  # of shutil.rmtree
            where = os.path.join(os.readlink(f"/proc/self/fd/{options['dir_fd']}"), first)
        path = self._path(where)
        if name == "fsync":
            if path is not None:
                self.changes.append(Sync(self._find(path)))
            return None
        is_new = path is not None and name == "open" and not os.path.lexists(where)
        result = call(first, *args, **options)
        if path is not None and (name != "open" or is_new):
            self._take(name, path, self._path(args[0]) if name in ("rename", "replace", "link") else None)
        return result

    def _take(self, call: str, path: tuple[str, ...], to: tuple[str, ...] | None) -> None:
        match call:
            case "write" | "ftruncate":
                node = self._find(path)
                self._nodes[node] = content = self.folder.joinpath(*path).read_bytes()
                self.changes.append(Bytes(node, content))
            case "open" | "mkdir":
                number = max(self._nodes) + 1
                self._nodes[number] = {} if call == "mkdir" else b""
                self.kinds[number] = type(self._nodes[number])
                self._name(path, number)
            case "unlink" | "rmdir":
                self._name(path, None)
            case "link":
                assert to is not None
                self._name(to, self._find(path))
            case _:
                assert to is not None and to[:-1] == path[:-1]  # nothing here is moved from folder to folder
                self._name(to, self._find(path), path[-1])

    def _name(self, path: tuple[str, ...], target: int | None, old: str | None = None) -> None:
        change = Name(self._find(path[:-1]), path[-1], target, old)
        rename(self._nodes, change)
        self.changes.append(change)

    def _find(self, path: tuple[str, ...]) -> int:
        number = 0
        for name in path:
            names = self._nodes[number]
            assert isinstance(names, dict)
            number = names[name]
        return number

    def _opened(self, file: Any, mode: str) -> Any:
        if "r" in mode or isinstance(file, int) or self._path(file) is None:
            return file
        return os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)


def after_power_cuts(recorder: Recorder, into: Path, seeds: int) -> Iterator[Path]:
    """Folders that a power cut may leave, so many of each moment of what was recorded."""
    for end in range(len(recorder.changes) + 1):
        for seed in range(seeds):
            print(f"cut after {recorder.changes[end - 1] if end else 'nothing'}, seed {seed}")  # for a test that fails
            shutil.rmtree(into, ignore_errors=True)
            _write(what_is_left(recorder, end, seed), 0, into)
            yield into


def what_is_left(recorder: Recorder, end: int, seed: int) -> Nodes:
    """After the first ``end`` changes. Seed 0 loses all that it may, 1 all bytes and no name, 2 all names and no byte,
    3 nothing, any other whatever chance has it."""
    chance = random.Random(f"{end} {seed}")
    keep_bytes = {0: 0.0, 1: 0.0, 2: 1.0, 3: 1.0}.get(seed, 0.5)
    keep_names = {0: 0.0, 1: 1.0, 2: 0.0, 3: 1.0}.get(seed, 0.8)
    changes, synced = recorder.changes[:end], set[int]()
    lasting = [False] * end
    for place in reversed(range(end)):
        change = changes[place]
        lasting[place] = change.node in synced
        if isinstance(change, Sync):
            synced.add(change.node)
    nodes, cut = copy.deepcopy(recorder.before), set[int]()
    for number, kind in recorder.kinds.items():
        nodes[number] = kind()
    for change, lasts in zip(changes, lasting, strict=True):
        if isinstance(change, Name):
            if not lasts and (change.node in cut or chance.random() >= keep_names):
                cut.add(change.node)
                continue
            rename(nodes, change)
        elif isinstance(change, Bytes):
            if lasts or chance.random() < keep_bytes:
                nodes[change.node] = change.content
            elif seed > 3 and chance.random() < 0.5:
                nodes[change.node] = change.content[: len(change.content) // 2]
    return nodes


def rename(nodes: Nodes, change: Name) -> None:
    names = nodes[change.node]
    assert isinstance(names, dict)
    if change.old is not None:
        names.pop(change.old, None)
    if change.target is None:
        names.pop(change.name, None)
    else:
        names[change.name] = change.target


def _write(nodes: Nodes, number: int, path: Path) -> None:
    content = nodes[number]
    if isinstance(content, bytes):
        path.write_bytes(content)
        return
    path.mkdir()
    for name, each in content.items():
        _write(nodes, each, path / name)
