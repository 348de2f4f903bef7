"""Errors that are not defects of the program: what a user can mend, and a stop that was requested."""

from __future__ import annotations

import difflib
import errno
import re
import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum, StrEnum
from functools import partial
from pathlib import Path
from typing import Any

from .gates import one_line as one_line
from .gates import shortened

_LONGEST = 600
"""The largest number of characters in what is wrong."""
_LACKS_SUBJECT = re.compile(
    r"(already|applies|cannot|contains|does|finds|gives|has|holds|is|lists|names|needs|renders|shows|was) "
)
"""Beginnings of what is wrong whose subject is the thing named in ``where``."""
_NO_MEMORY = ("allocate memory", "DefaultCPUAllocator: not enough memory", "std::bad_alloc")  # in libraries' own errors
_SILENT = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN, errno.EINTR, errno.ENOMEM)


class ExitCode(IntEnum):
    """The exit status of the engine and of run_plgs.py. 75 is EX_TEMPFAIL of sysexits.h, at which render farms try
    again. Codes from 129 on are the shell's numbers for processes ended by a signal: closed terminal, Ctrl-C,
    SIGTERM."""

    FINISHED = 0
    INTERNAL_ERROR = 1
    BAD_INPUT = 2
    CANCELLED = 3
    BUSY = 75
    HUNG_UP = 129
    INTERRUPTED = 130
    TERMINATED = 143


OF_SIGNALS = {"SIGHUP": ExitCode.HUNG_UP, "SIGINT": ExitCode.INTERRUPTED, "SIGTERM": ExitCode.TERMINATED}
"""The signals that every command takes as a request to stop, and its exit status then. Windows lacks some of them."""
STOPPED = frozenset({ExitCode.CANCELLED, *OF_SIGNALS.values()})
"""How a process that was asked to stop ends."""


class ErrorCode(StrEnum):
    """The kinds of errors that a caller treats differently. The panel offers a button for most of them."""

    BAD_INPUT = "bad-input"
    BUSY = "busy"  # another process is working there: try again later
    NO_ENGINE = "no-engine"  # no usable Python: set the engine up
    LACKS_PART = "lacks-part"  # the engine lacks packages that can be added to it
    NO_POSES = "no-poses"  # photos or a film: make their poses
    NO_MASKS = "no-masks"  # the scene has no masks: make them
    NO_MEMORY = "no-memory"  # the lift was refused before it began: make it fit
    DISK_FULL = "disk-full"
    NOT_FINISHED = "not-finished"  # the lift has no result yet: resume it
    DAMAGED = "damaged"  # the result is not as it was written: resume the lift
    KILLED = "killed"  # a signal ended the engine
    INTERNAL = "internal"  # a defect, a crash, or memory that ran out

    @property
    def exit_code(self) -> ExitCode:
        """The exit status of a process that ends with an error of this code."""
        match self:
            case ErrorCode.INTERNAL | ErrorCode.KILLED | ErrorCode.DISK_FULL:
                return ExitCode.INTERNAL_ERROR
            case ErrorCode.BUSY:
                return ExitCode.BUSY
        return ExitCode.BAD_INPUT


_USUAL = ErrorCode.BAD_INPUT
MEMORY_IS_GONE = "no memory is left"
"""Words in each reader's error that only more memory would fix."""


class PlgsError(Exception):
    """An error that a user can mend, in the input, a lift folder or the computer: what is wrong, where, and what to do.
    ``key`` names the kind of fault, such as "no-frame", and stays when its sentence is reworded; all places with the
    same fault share one key. ``option`` is the command-line option that ``fix`` advises, spelt as there, such as
    "--masks" (several are separated by blanks, "" means none); the panel shows the name of its own field instead. With
    LACKS_PART, ``option`` is the name of the part. ``what`` may quote a library's text: it becomes one line."""

    def __init__(
        self, key: str, what: str, where: Path | str, fix: str, *, code: ErrorCode = _USUAL, option: str = ""
    ) -> None:
        self.what = shortened(what, _LONGEST)
        if MEMORY_IS_GONE in self.what:  # whatever it was read for: the file may be sound
            fix, option = "Close other programs, or use a computer with more memory.", ""
        self.key, self.where, self.fix, self.code, self.option = key, str(where), fix, code, option
        super().__init__(one_line(f"{ended(self.problem)} {fix}" if fix else self.problem))

    def __reduce__(self) -> tuple[Any, ...]:
        """Tell pickle how to rebuild the error, for example in another process."""
        return partial(type(self), code=self.code, option=self.option), (self.key, self.what, self.where, self.fix)

    @property
    def exit_code(self) -> ExitCode:
        return self.code.exit_code

    @property
    def problem(self) -> str:
        """The text of what is wrong and where, as `problem_of` joins them."""
        return problem_of(self.what, self.where)


def problem_of(what: str, where: str) -> str:
    """Return a sentence of both: "room has no poses", or "no scheduler answers: HOST" if ``what`` has a subject."""
    if not where:
        return what
    return f"{where} {what}" if _LACKS_SUBJECT.match(what) else f"{what}: {where}"


def ended(text: str) -> str:
    """Return ``text`` with a full stop, unless it has its own end, as a question has."""
    return text if text.endswith((".", "?", "!", "…")) else f"{text}."


def did_you_mean(text: str, known: Iterable[str], least: float = 0.6) -> str:
    """Return "Did you mean NAME? " with the ``known`` name that is most like ``text``, or "" if none reaches ``least``
    (0 to 1) of likeness."""
    near = difflib.get_close_matches(text, [*known], 1, least)
    return f"Did you mean {near[0]}? " if near else ""


def lacks_part(what: str, where: Path | str, name: str) -> PlgsError:
    """Return the error for an engine without the packages of the part ``name``, which `engine add` can install;
    ``what`` and ``where`` are as in `PlgsError`."""
    fix = f"Add it to the engine: {shlex.quote(sys.executable)} -m engine add {name}."
    return PlgsError("lacks-part", what, where, fix, code=ErrorCode.LACKS_PART, option=name)


@contextmanager
def reading(path: Path, fix: str = "Check that it exists, and that you may read it.") -> Iterator[None]:
    """Turn an OSError in a ``with`` block into a PlgsError with the advice ``fix``, for ``path`` or the file named."""
    try:
        yield
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise PlgsError("unreadable", what, error.filename or path, fix) from error


class Cancelled(Exception):
    """The engine was asked to stop. The last checkpoint is kept and can be resumed (exit code 3)."""


def lacks_memory(error: BaseException) -> bool:
    """Whether an error means that memory ran out. C++ libraries raise errors of their own: torch (CPU, GPU), OpenCV."""
    is_kind = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    return is_kind or any(words in str(error) for words in _NO_MEMORY)


def is_silence(error: BaseException | None) -> bool:
    """Whether an error, or its cause, is a disk or network share that did not answer. The file may still be good."""
    causes = (error, error.__cause__ if error is not None else None)
    return any(isinstance(one, OSError) and one.errno in _SILENT for one in causes)
