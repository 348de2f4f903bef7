"""What a power cut may leave: what was recorded is played again, less what no fsync had made lasting.

A file's bytes last from the fsync of the file on, a name from the fsync of its folder on. Of the rest anything may be
lost: names of one folder from the last one back, those of different folders and bytes in any order.
"""

from __future__ import annotations

import copy
import io
import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

Nodes = dict[int, bytes | dict[str, int]]
"""By number: a file's bytes, or the numbers of what a folder holds. 0 is the folder that is watched."""
CALLS = ("open", "write", "rename", "replace", "link", "unlink", "mkdir", "rmdir", "ftruncate")


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


class Recorder:
    """Records what happens below ``folder``, inside `recording`."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self._patch = folder, patch
        self._nodes: Nodes = {}
        self._read(folder)
        self.before = copy.deepcopy(self._nodes)
        self.kinds: dict[int, type] = {}
        self.changes: list[Bytes | Name | Sync] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        calls = {name: getattr(os, name) for name in CALLS}
        opening, reopening = io.open, os.fdopen
        with self._patch.context() as patch:
            for name, call in calls.items():
                patch.setattr(os, name, self._wrapped(name, call))
            patch.setattr(os, "fsync", self._sync)
            patch.setattr(io, "open", lambda file, *rest, **more: self._file(opening, file, *rest, **more))
            patch.setattr(os, "fdopen", lambda file, *rest, **more: self._file(reopening, file, *rest, **more))
            yield

    def _read(self, path: Path) -> int:
        number = len(self._nodes)
        self._nodes[number] = b""
        is_file = path.is_file()
        self._nodes[number] = path.read_bytes() if is_file else {each.name: self._read(each) for each in path.iterdir()}
        return number

    def _new(self, content: bytes | dict[str, int]) -> int:
        number = max(self._nodes) + 1
        self._nodes[number] = content
        self.kinds[number] = type(content)
        return number

    def _wrapped(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(first: Any, *args: Any, **options: Any) -> Any:
            where = first
            if options.get("dir_fd") is not None:  # of shutil.rmtree
                where = os.path.join(os.readlink(f"/proc/self/fd/{options['dir_fd']}"), first)
            path = self._inner(where)
            is_new = path is not None and name == "open" and not os.path.lexists(where)
            result = call(first, *args, **options)
            if path is not None and (name != "open" or is_new):
                self._take(name, path, self._inner(args[0]) if name in ("rename", "replace", "link") else None)
            return result

        return wrapped

    def _take(self, call: str, path: tuple[str, ...], to: tuple[str, ...] | None) -> None:
        match call:
            case "write" | "ftruncate":
                node = self._find(path)
                self._nodes[node] = content = self.folder.joinpath(*path).read_bytes()
                self.changes.append(Bytes(node, content))
            case "open":
                self._name(path, self._new(b""))
            case "mkdir":
                self._name(path, self._new({}))
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

    def _file(self, opening: Callable[..., Any], file: Any, mode: str = "r", *rest: Any, **options: Any) -> Any:
        if "r" in mode or self._inner(file) is None:
            return opening(file, mode, *rest, **options)
        if not isinstance(file, int):
            file = os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        raw = io.BufferedWriter(_Raw(file, "w"))
        return raw if "b" in mode else io.TextIOWrapper(raw, options.get("encoding"), write_through=True)

    def _inner(self, where: Any) -> tuple[str, ...] | None:
        path = Path(os.readlink(f"/proc/self/fd/{where}") if isinstance(where, int) else os.fspath(where))
        return path.relative_to(self.folder).parts if path.is_relative_to(self.folder) else None

    def _sync(self, descriptor: int) -> None:
        path = self._inner(descriptor)
        if path is not None:
            self.changes.append(Sync(self._find(path)))


class _Raw(io.FileIO):
    def write(self, data: Any) -> int:
        return os.write(self.fileno(), bytes(data))


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
