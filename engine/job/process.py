"""The engine as a process of its own: which Python runs it, with what environment, and how it is ended."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from .errors import JobError

ROOT = Path(__file__).resolve().parents[2]
"""The folder that holds ``engine``: the repository, or the installed extension."""

_ENGINE_MODULES = ("torch", "numpy")
# What a parent Python, Blender's above all, may have set for itself and would break another Python with.
_FOREIGN = (
    "PYTHONHOME",
    "PYTHONPATH",
    "PYTHONSTARTUP",
    "PYTHONEXECUTABLE",
    "PYTHONUSERBASE",
    "__PYVENV_LAUNCHER__",
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "DYLD_LIBRARY_PATH",
)


def engine_python(root: Path = ROOT, environ: Mapping[str, str] = os.environ) -> Path:
    """The Python to run the engine with: PLGS_ENGINE_PYTHON, else ``.venv`` beside the code, else this one.

    Raises JobError when none of them has what the engine needs. Takes about 0.1 s.
    """
    chosen = environ.get("PLGS_ENGINE_PYTHON")
    if chosen:
        python = Path(chosen).absolute()  # not resolved: a venv's Python knows its venv by the link
        _refuse_unfit(python, "Correct the variable PLGS_ENGINE_PYTHON, or unset it.")
        return python
    own = environment_python(root)
    if own.exists():
        _refuse_unfit(own, f"Run 'make set-up' in {root}.")
        return own
    if all(importlib.util.find_spec(name) for name in _ENGINE_MODULES):
        return Path(sys.executable)
    fix = f"Run 'make set-up' in {root}, or set PLGS_ENGINE_PYTHON to a Python that has torch."
    raise JobError("no Python for the engine", own, fix)


def environment_python(root: Path = ROOT) -> Path:
    """Where the Python of the environment lies that ``make`` sets up; it may be missing."""
    return root / ".venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def missing_modules(python: Path, names: Sequence[str]) -> list[str]:
    """Which of the modules another Python cannot find. Nothing is imported. Raises JobError when it does not run."""
    code = "import importlib.util, sys; print(*(n for n in sys.argv[1:] if not importlib.util.find_spec(n)))"
    try:
        answer = subprocess.run(
            [python, "-c", code, *names], env=clean_environment(), capture_output=True, text=True, timeout=60
        )
    except OSError as error:
        raise JobError(f"cannot be run ({error.strerror})", python, "It has to be a Python.") from error
    if answer.returncode != 0:
        raise JobError("does not work as a Python", python, "Try it in a terminal.")
    return answer.stdout.split()


def clean_environment(root: Path | None = None) -> dict[str, str]:
    """This process's environment without what is meant for its own Python; ``root`` becomes importable."""
    environment = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    environment |= {"PYTHONNOUSERSITE": "1", "PYTHONUNBUFFERED": "1"}
    if root is not None:
        environment["PYTHONPATH"] = str(root)
    return environment


class EngineProcess:
    """A started engine. It ends by itself when this process does: it watches the pipe that `Popen.stdin` is."""

    def __init__(self, command: Sequence[str | Path], root: Path = ROOT) -> None:
        """Start ``command``. Raises JobError when it cannot be started."""
        # Before the engine opens its log, and when it fails to, it talks to a file without a name: nobody has to
        # drain that, unlike a pipe, and no thread is needed.
        self._words = tempfile.TemporaryFile()  # noqa: SIM115 - closed in `close`
        flags: int = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0) | getattr(subprocess, "CREATE_NO_WINDOW", 0)
        try:
            self._process = subprocess.Popen(
                [str(part) for part in command],
                cwd=root,
                env=clean_environment(root),
                stdin=subprocess.PIPE,
                stdout=self._words,
                stderr=self._words,
                start_new_session=True,  # Ctrl-C in the terminal is for the parent, which then asks politely
                creationflags=flags,
            )
        except OSError as error:
            self._words.close()
            raise JobError(f"cannot be run ({error.strerror})", command[0], "It has to be a Python.") from error
        self._code: int | None = None

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        return self._process.poll()

    def words(self) -> str:
        """What it said outside its log: nothing, or why it could not begin."""
        self._words.seek(0)
        return self._words.read().decode(errors="replace").strip()

    def kill(self) -> None:
        """End it and its children at once. Nothing happens when it is over already. Returns when it has ended."""
        if self._process.poll() is None:
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """Let go of it; one that still runs takes that as the parent's end and stops."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._words.close()


def engine_command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
    """The command that works on a lift folder and stays with its parent."""
    command: list[str | Path] = [python, "-m", "engine", "lift", lift, "--stay-with-parent"]
    return [*command, "--resume"] if resume else command


def _refuse_unfit(python: Path, fix: str) -> None:
    if not python.exists():
        raise JobError("the engine's Python is not there", python, fix)
    missing = missing_modules(python, _ENGINE_MODULES)
    if missing:
        raise JobError(f"the engine's Python lacks {', '.join(missing)}", python, fix)
