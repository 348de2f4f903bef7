"""Editors of one lift that are killed, or that sleep amid an edit. Run as a script:

editors.py LIFT kills COUNT     four editors at once, killed again and again, until COUNT edits were answered
editors.py LIFT sleeps          an editor sleeps at each call to the file system in turn

Prints a JSON object: the uids of all edits that were ``answered`` with success, those of them that were ``lost`` (with
what happened), the editors that were ``killed``, and the calls at which one ``slept``.
"""

from __future__ import annotations

import datetime
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
# ruff: noqa: E402 - what follows is found only now

from engine.corrections import correct, edits, making, read_edits
from engine.errors import ErrorCode, PlgsError

DESK = 2
CALLS = ("open", "fdopen", "fsync", "replace", "link", "unlink", "mkdir", "scandir", "stat")


class Backwards(datetime.datetime):
    """A clock that goes back by an hour at each look."""

    looks = 0

    @classmethod
    def now(cls, zone: Any = None) -> Backwards:
        cls.looks += 1
        return cls.fromtimestamp(2e9 - 3600 * cls.looks, zone)


class Editor:
    """A fork that makes edits and tells the uid of each that succeeded, a line each; "busy" for one that did not."""

    def __init__(self, lift: Path, name: str, count: int, sleeps_at: int = 0) -> None:
        reading, writing = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(reading)
            try:
                if sleeps_at:
                    self._sleep_at(sleeps_at, writing)
                for number in range(count):
                    os.write(writing, f"{edited(lift, f'{name} {number}')}\n".encode())
                os.write(writing, b"end\n")
            finally:
                os._exit(0)
        os.close(writing)
        self._lines = os.fdopen(reading)

    def _sleep_at(self, at: int, writing: int) -> None:
        tell, kill, counted = os.write, os.kill, [0]

        def sleeping(call: Callable[..., Any], name: str) -> Callable[..., Any]:
            def slept(*args: Any, **options: Any) -> Any:
                counted[0] += 1
                if counted[0] == at:
                    tell(writing, f"sleeps before {name}\n".encode())
                    kill(os.getpid(), signal.SIGSTOP)
                return call(*args, **options)

            return slept

        for name in CALLS:
            setattr(os, name, sleeping(getattr(os, name), name))

    def line(self) -> str:
        return self._lines.readline().strip()

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def rest(self) -> list[str]:
        """The lines until its end."""
        lines = self._lines.read().splitlines()
        self._lines.close()
        os.waitpid(self.pid, 0)
        return lines


def edited(lift: Path, name: str) -> str:
    """Make an edit. Returns its uid, "busy", or another error."""
    try:
        return correct(lift, lambda state, _: making.rename(state, DESK, name))[0].uid
    except PlgsError as error:
        return "busy" if error.code is ErrorCode.BUSY else f"error: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def kills(lift: Path, count: int) -> dict[str, object]:
    chance, told, killed, odd = random.Random(0), list[str](), 0, list[str]()
    while len(told) < count:
        four = [Editor(lift, f"editor {number}", 12) for number in range(4)]
        lines = list[str]()
        for editor in chance.sample(four, 3):
            lines += [editor.line() for _ in range(chance.randint(1, 8))]
            time.sleep(chance.uniform(0.0, 0.02))
            editor.kill()
            killed += 1
        for editor in four:
            lines += editor.rest()
        told += [line for line in lines if len(line) == 32]
        odd += [line for line in lines if len(line) != 32 and line not in ("busy", "end", "")]
    found = [edit.uid for edit in read_edits(lift)]
    assert len(set(found)) == len(found)
    return {"answered": told, "lost": sorted(set(told) - set(found)) + odd, "killed": killed}


def sleeps(lift: Path) -> dict[str, object]:
    told, lost, slept = list[str](), list[str](), list[str]()
    while True:
        sleeper = Editor(lift, "sleeper", 1, len(slept) + 1)
        where = sleeper.line()
        lines = [] if where.startswith("sleeps") else [where]
        if not lines:
            slept.append(where)
            lines += [edited(lift, f"awake {number}") for number in range(2)]
            os.kill(sleeper.pid, signal.SIGCONT)
        lines += sleeper.rest()
        found = {edit.uid for edit in read_edits(lift)}
        new = [line for line in lines if len(line) == 32]
        lost += [f"{where}: {uid}" for uid in {*told, *new} - found]
        lost += [f"{where}: {line}" for line in lines if len(line) != 32 and line not in ("busy", "end")]
        told = [uid for uid in (*told, *new) if uid in found]
        if not where.startswith("sleeps"):
            return {"answered": told, "lost": lost, "slept": slept}


if __name__ == "__main__":
    edits.datetime = Backwards  # type: ignore[misc]
    os.fsync = lambda descriptor: None  # a kill loses nothing that was written, synced or not
    if sys.argv[2] == "sleeps":  # nobody else is awake then
        edits._WAIT_S = 0.02  # the lock ends with its process alone
    place = Path(sys.argv[1])
    print(json.dumps(kills(place, int(sys.argv[3])) if sys.argv[2] == "kills" else sleeps(place)))
