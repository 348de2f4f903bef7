"""Commands of the engine of which one call to the file system fails (see failing_calls.c)."""

from __future__ import annotations

import errno
import json
import os
import shutil
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
_STATE = struct.Struct("=qqii512s")


@dataclass(frozen=True)
class Fault:
    """Call number ``at`` of a command (from 1), as ``kind`` of a ``file``, fails with ``error``."""

    at: int
    kind: str
    file: str
    error: int

    def __str__(self) -> str:
        return f"{errno.errorcode[self.error]} at call {self.at}, {self.kind} {self.file}"


def library(folder: Path) -> Path:
    """The compiled failing_calls.c."""
    made = folder / "failing_calls.so"
    command = ["cc", "-shared", "-fPIC", "-O1", "-Wall", "-o", made, HERE / "failing_calls.c", "-ldl"]
    subprocess.run([str(part) for part in command], check=True)
    return made


class State:
    """What the library counts, and which call fails."""

    def __init__(self, folder: Path, below: Path, *, alone: bool = False) -> None:
        self._path, self._trace = folder / "state", folder / "trace"
        self.set()
        self.variables = {
            "LD_PRELOAD": str(library(folder)),
            "PLGS_FAIL_STATE": str(self._path),
            "PLGS_FAIL_BELOW": str(below),
            "PLGS_FAIL_TRACE": str(self._trace),
            **({"PLGS_FAIL_ALONE": "1"} if alone else {}),
        }

    def set(self, at: int = 0, error: int = 0) -> None:
        """Begin to count, in the same file, as processes have mapped it."""
        with self._path.open("r+b" if self._path.exists() else "wb") as file:
            file.write(_STATE.pack(0, at, error, 0, b""))
        if self._trace.exists():
            os.truncate(self._trace, 0)

    @property
    def failed(self) -> str:
        """The call that failed; empty if none has."""
        *_, failed, what = _STATE.unpack(self._path.read_bytes())
        return what.rstrip(b"\0").decode(errors="replace") if failed else ""

    def calls(self) -> list[tuple[str, str]]:
        """The kind and the file of each call since the last `set`."""
        lines = self._trace.read_text(errors="replace").splitlines()
        return [(line.split(" ", 1)[0], line.split(" ", 1)[1]) for line in lines]


def faults_of(calls: list[tuple[str, str]], most: int) -> list[Fault]:
    """Each call with each error that it may have. Where that is more than ``most``: calls at equal distances of the
    first and the last of each kind and file, with errors in turns."""
    numbered = list(enumerate(calls, start=1))
    every = [Fault(at, kind, file, error) for at, (kind, file) in numbered for error in errors_of(kind)]
    if len(every) <= most:
        return every
    first, last = {call: at for at, call in reversed(numbered)}, {call: at for at, call in numbered}
    ends = sorted({*first.values(), *last.values()})
    sampled = ends if len(ends) <= most else [ends[place * len(ends) // most] for place in range(most)]
    found = []
    for turn, at in enumerate(sampled):
        kind, file = calls[at - 1]
        errors = errors_of(kind)
        found.append(Fault(at, kind, file, errors[turn % len(errors)]))
    return found


def errors_of(kind: str) -> tuple[int, ...]:
    """The errors that a call of this kind may have."""
    made = (errno.EIO, errno.ENOSPC, errno.EDQUOT)
    return {"open": (errno.EIO, errno.EMFILE), "create": (*made, errno.EMFILE)}.get(kind, made)


class Commands:
    """The engine's commands, one after another, with one thread each."""

    def __init__(self, scene: Path, folder: Path, state: State) -> None:
        one_thread = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")}
        self._said = folder / "said"
        self._server = subprocess.Popen(
            [sys.executable, str(HERE / "forked_commands.py"), str(scene), str(folder / "warm")],
            env=os.environ | one_thread | state.variables, text=True, bufsize=1,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert self._answer() == 0

    def run(self, *arguments: str | Path) -> tuple[int, str]:
        """A command's exit code, and what it printed."""
        assert self._server.stdin is not None
        asked = {"arguments": [str(part) for part in arguments], "said": str(self._said)}
        self._server.stdin.write(json.dumps(asked) + "\n")
        return self._answer(), self._said.read_text(errors="replace")

    def close(self) -> None:
        self._server.kill()
        self._server.wait()

    def _answer(self) -> int:
        assert self._server.stdout is not None
        return int(self._server.stdout.readline())


def renewed(folder: Path, before: Path) -> None:
    """Make ``folder`` a copy of ``before``."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(before, folder)
