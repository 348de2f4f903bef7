"""Deleting an environment takes seconds: it is moved aside at once, and a program of its own deletes it."""

from __future__ import annotations

import sys
from pathlib import Path

_PREFIX = "trash-"
_DELETE = "import shutil, sys; [shutil.rmtree(path, ignore_errors=True) for path in sys.argv[1:]]"


def throw_away(path: Path, trash_can: Path) -> None:
    """Move a folder into ``trash_can``, a folder on the same disk. Nothing happens when it is not there.

    Raises OSError, on Windows also when a program in it still runs.
    """
    if not path.exists() and not path.is_symlink():
        return
    number = 0
    while (target := trash_can / f"{_PREFIX}{number}").exists():
        number += 1
    path.rename(target)


def thrown_away(trash_can: Path) -> list[Path]:
    """What waits there to be deleted."""
    return sorted(trash_can.glob(f"{_PREFIX}*"))


def delete_command(paths: list[Path], python: Path | None = None) -> list[str | Path]:
    """The command that deletes folders, whatever of them can be."""
    return [python or Path(sys.executable), "-I", "-c", _DELETE, *paths]
