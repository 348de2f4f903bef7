"""The engine as a separate process: which Python runs it, in what environment, and how it is ended."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import IO

from ..errors import ErrorCode, PlgsError
from .environment import made_environment, python_in
from .system import kill_with_children, start_options

ROOT = Path(__file__).resolve().parents[2]
"""The folder that holds ``engine``: the repository, or the installed extension."""

_OUTPUT_TAIL = 64_000
"""The most bytes of a program's output that are read. A message is shorter."""
_ANSWER_S = 60.0  # seconds within which a Python must answer, even on a slow disk
_KILLED_S = 5.0  # seconds that a killed process may take to end
_MISSING = "missing modules:"
_ENGINE_MODULES = ("torch", "numpy")
# Variables that a parent Python, such as Blender's, sets for itself and that would break a different Python.
_FOREIGN = (
    "PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "PYTHONEXECUTABLE", "PYTHONUSERBASE", "__PYVENV_LAUNCHER__",
    "LD_LIBRARY_PATH", "LD_PRELOAD", "DYLD_LIBRARY_PATH",
)  # fmt: skip


class Origin(StrEnum):
    """Where the engine's Python was found, in the order in which the places are tried."""

    VARIABLE = "the variable PLGS_ENGINE_PYTHON"
    CHOSEN = "the preferences"
    SET_UP = "Set Up Engine"
    BESIDE = "the environment beside the code"
    THIS = "this Python"


@dataclass(frozen=True)
class ChosenPython:
    """The Python that runs the engine, why it was chosen (``origin``), and the ``fix`` to do if it is unfit."""

    python: Path
    origin: Origin
    fix: str


def choose_python(
    root: Path = ROOT, environ: Mapping[str, str] = os.environ, chosen: Path | None = None
) -> ChosenPython:
    """Return the first Python that exists of: PLGS_ENGINE_PYTHON, the ``chosen`` one from the preferences, the
    environment that "Set up engine" made, ``.venv`` beside the code, and this Python if it has torch. Its packages are
    not checked, so this takes milliseconds. Raises PlgsError if there is none."""
    variable = environ.get("PLGS_ENGINE_PYTHON")
    if variable:  # not resolved, as a venv's Python finds its venv by the link
        fix = "Correct the variable PLGS_ENGINE_PYTHON, or unset it."
        return ChosenPython(Path(variable).absolute(), Origin.VARIABLE, fix)
    if chosen is not None:
        fix = "Choose another Python for the engine in the preferences, or clear the choice."
        return ChosenPython(chosen.absolute(), Origin.CHOSEN, fix)
    made = made_environment(root, environ)
    if made is not None:
        return ChosenPython(python_in(made), Origin.SET_UP, "Press 'Set Up Engine' again.")
    beside = python_in(root / ".venv")
    if beside.exists():
        return ChosenPython(beside, Origin.BESIDE, f"Run 'make set-up' in {root}.")
    if all(importlib.util.find_spec(name) for name in _ENGINE_MODULES):
        return ChosenPython(Path(sys.executable), Origin.THIS, "Press 'Set Up Engine' in the preferences.")
    make = f"run 'make set-up' in {root}" if (root / "Makefile").exists() else "press 'Set Up Engine' in Blender"
    fix = f"Please {make}, or set PLGS_ENGINE_PYTHON to a Python that has torch."
    raise PlgsError("no-python", "there is no Python for the engine", beside, fix, code=ErrorCode.NO_ENGINE)


def engine_python(root: Path = ROOT, environ: Mapping[str, str] = os.environ, chosen: Path | None = None) -> Path:
    """Return the Python of `choose_python`, within 0.1 s. Raises PlgsError if there is none, or it lacks packages."""
    choice = choose_python(root, environ, chosen)
    what = "the engine's Python does not exist"
    if choice.python.exists():
        missing = missing_modules(choice.python, _ENGINE_MODULES)
        if not missing:
            return choice.python
        what = f"the engine's Python lacks {', '.join(missing)}"
    raise PlgsError("python-unfit", what, choice.python, choice.fix, code=ErrorCode.NO_ENGINE)


def missing_modules(python: Path, names: Sequence[str]) -> list[str]:
    """Return which modules another Python cannot find, without importing them. Raises PlgsError if it does not run."""
    find = "(n for n in sys.argv[1:] if not importlib.util.find_spec(n))"
    code = f"import importlib.util, sys; print({_MISSING!r}, *{find})"
    try:
        answer = subprocess.run(
            [python, "-I", "-c", code, *names], env=clean_environment(), capture_output=True, timeout=_ANSWER_S
        )
    except subprocess.TimeoutExpired as error:
        raise PlgsError("silent", f"does not answer within {_ANSWER_S:g} s", python, "Try it in a terminal.") from error
    except OSError as error:
        raise PlgsError("not-runnable", f"cannot be run ({error.strerror})", python, "Choose a Python.") from error
    # Only the last line counts, as what a Python runs at its start may also print something.
    *_, line = ["", *answer.stdout.decode(errors="replace").splitlines()]
    if answer.returncode != 0 or not line.startswith(_MISSING):
        raise PlgsError("not-a-python", "does not work as a Python", python, "Try it in a terminal.")
    return line.removeprefix(_MISSING).split()


def clean_environment(root: Path | None = None) -> dict[str, str]:
    """Return this process's environment variables but those for its own Python; modules in ``root`` can be imported."""
    environment = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    environment |= {"PYTHONNOUSERSITE": "1", "PYTHONUNBUFFERED": "1"}
    environment.setdefault("MALLOC_ARENA_MAX", "2")  # glibc keeps freed memory for each thread, which other arrays lack
    return environment if root is None else environment | {"PYTHONPATH": str(root)}


class ChildProcess:
    """A program without a window whose output goes to a file, and which can be killed together with its children."""

    def __init__(
        self,
        command: Sequence[str | Path],
        *,
        cwd: Path,
        environment: Mapping[str, str],
        output: IO[bytes],
        stdin: int = subprocess.DEVNULL,
        keep_open: Sequence[int] = (),
    ) -> None:
        """Start ``command`` in ``cwd``; ``output`` also takes its errors. On POSIX, descriptors in ``keep_open`` stay
        open. Raises PlgsError if it fails."""
        try:
            self._process = subprocess.Popen(
                [str(part) for part in command],
                cwd=cwd,
                env=dict(environment),
                stdin=stdin,
                stdout=output,
                stderr=subprocess.STDOUT,
                **start_options(keep_open),
            )
        except OSError as error:
            what = f"cannot be run ({error.strerror})"
            raise PlgsError("not-runnable", what, command[0], "Choose another Python.") from error
        except ValueError as error:
            fix = "Choose folders with different names."
            raise PlgsError("bad-path", f"cannot be started with this path ({error})", command[0], fix) from error

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_code(self) -> int | None:
        """Return the exit code: None while it runs, negative if a signal ended it."""
        return self._process.poll()

    def kill(self) -> None:
        """Kill the process and its children, if it still runs, and wait for its end. If it hangs on a disk that does
        not answer, return after a few seconds; it ends when the disk answers."""
        if self._process.poll() is None:
            kill_with_children(self._process)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_KILLED_S)


class EngineProcess(ChildProcess):
    """A started engine. If it ``is_tied``, it ends when this process does, as it watches its standard input, a pipe.
    Otherwise it continues when this process ends."""

    def __init__(
        self, command: Sequence[str | Path], *, is_tied: bool = True, variables: Mapping[str, str] | None = None
    ) -> None:
        """Start ``command``; ``variables`` are added to its environment. Raises PlgsError if it cannot be started."""
        # Until the engine has opened its log, it writes to a file without a name. Unlike a pipe, this needs no thread
        # to drain it.
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - closed in `close`
        stdin = subprocess.PIPE if is_tied else subprocess.DEVNULL
        try:
            environment = clean_environment(ROOT) | dict(variables or {})
            super().__init__(command, cwd=ROOT, environment=environment, output=self._output, stdin=stdin)
        except PlgsError:
            self._output.close()
            raise

    def output_tail(self) -> str:
        """Return the end of what it wrote outside the log, such as why it could not start; "" if nothing."""
        length = self._output.seek(0, os.SEEK_END)
        self._output.seek(max(0, length - _OUTPUT_TAIL))
        return self._output.read().decode(errors="replace").strip()

    def close(self) -> None:
        """Close the pipe to the engine. A tied engine that still runs stops, as it does when its parent ends."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._output.close()


def engine_call(python: Path, root: Path = ROOT, program: str = "engine") -> list[str | Path]:
    """Return the first arguments of every command of the engine. ``program`` is the module to run, one that has the
    engine's commands. With -I, Python imports nothing from the current folder, which may be someone else's scene, nor
    from folders that environment variables add."""
    return [python, "-I", "-u", root / program / "__main__.py"]  # -u, as -I ignores PYTHONUNBUFFERED


def engine_command(python: Path, lift: Path, *, resume: bool, program: str = "engine") -> list[str | Path]:
    """Return the command that starts or, with ``resume``, resumes a lift in the folder ``lift``."""
    return [*engine_call(python, program=program), "lift", lift, *(["--resume"] if resume else [])]
