"""The Debian tree of `set_up/blender_window.py`, entered: commands run in it until the tests end, however they end."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent.parent


def paths_of_this_python() -> list[Path]:
    """What the Python that runs this, and its environment, need to run in the tree: at the same paths there."""
    environment = Path(sys.prefix).resolve()
    base = Path(sys.base_prefix).resolve()
    if base != Path("/usr"):
        return [environment, base]
    # Debian's own Python: /usr is the tree's, only this version's interpreter and library are ours.
    return [environment, Path(sys.executable).resolve(), Path(sysconfig.get_path("stdlib")).resolve()]


class Tree:
    """Processes in the tree live under one shell there, which ends with our end of its pipe and takes all along."""

    def __init__(self, folder: Path, visible: Sequence[Path]) -> None:
        """Enter the tree in `folder`, with the paths `visible` of this machine in it."""
        enter = ["sh", str(ROOT / "set_up" / "in_tree.sh"), str(folder), *map(str, visible), "--"]
        # A shell, so that somebody reaps what others leave behind; two commands, so that it does not become the first.
        self._keeper = subprocess.Popen(
            [*enter, "sh", "-c", "echo entered; cat; exit"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._keeper.stdout is not None
        if self._keeper.stdout.readline() != "entered\n":
            raise RuntimeError(f"the tree in {folder} cannot be entered: see the lines above")
        children = Path(f"/proc/{self._keeper.pid}/task/{self._keeper.pid}/children")
        self._first = children.read_text().split()[0]
        self.environment: dict[str, str] = {"PATH": "/usr/bin:/bin:/usr/sbin:/sbin", "LC_ALL": "C.UTF-8"}

    def start(
        self, *command: str, log: IO[bytes] | int | None = None, pass_fds: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> subprocess.Popen[bytes]:  # fmt: skip
        """Start a command in the tree; it is killed when the returned process is."""
        enter = ["nsenter", "--target", self._first, "--mount", "--pid", "--root", "--wd"]
        return subprocess.Popen(
            [*enter, "setpriv", "--pdeathsig", "KILL", *command],
            env=self.environment | dict(environment or {}), pass_fds=pass_fds,
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT if log is not None else None,
        )  # fmt: skip

    def run(self, *command: str, timeout: float = PATIENCE_S) -> str:
        """Run a command in the tree to its end; its output. RuntimeError when it fails."""
        process = self.start(*command, log=subprocess.PIPE)
        output = process.communicate(timeout=timeout)[0].decode(errors="replace")
        if process.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}:\n{output}")
        return output

    def close(self) -> None:
        """Leave the tree: every process in it is killed, every mount gone."""
        assert self._keeper.stdin is not None
        self._keeper.stdin.close()
        try:
            self._keeper.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._keeper.kill()
            self._keeper.wait()
