"""A Python that can make the engine's environment: the one that runs this, or another one on this computer."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..job.environment import Version

PROBE = (
    "import importlib.util, json, sys; "
    "lacking = [name for name in ('venv', 'ensurepip') if not importlib.util.find_spec(name)]; "
    "print(json.dumps([sys.version_info[:2], sys.executable, lacking]))"
)
"""The program that a Python is checked with. It prints what `judge` reads."""
_MORE_FOLDERS = ("/opt/homebrew/bin", "/usr/local/bin", "/usr/bin")
"""Folders that are searched in addition to PATH: a Blender that was started from a dock has a short PATH."""


@dataclass(frozen=True)
class BasePython:
    """A Python that can make environments, with pip only if it ``has_pip`` in its ensurepip."""

    python: Path
    version: Version
    has_pip: bool = True


def candidates(given: Path | None, versions: Sequence[Version]) -> list[Path]:
    """The Pythons to try: only the given one, else the one that runs this and then those of the search path."""
    if given is not None:
        return [given]
    names = [f"python{major}.{minor}" for major, minor in versions] + ["python3", "python"]
    folders = list(dict.fromkeys([*os.get_exec_path(), *([] if os.name == "nt" else _MORE_FOLDERS)]))
    suffix = ".exe" if os.name == "nt" else ""
    found = [Path(folder) / f"{name}{suffix}" for name in names for folder in folders]
    runnable = [path for path in found if path.is_file() and os.access(path, os.X_OK)]
    return list(dict.fromkeys([Path(sys.executable), *runnable]))


def judge(output: str, code: int, versions: Sequence[Version]) -> BasePython | str:
    """The Python that answered PROBE, or why it is unfit, as the end of a sentence."""
    try:
        version, executable, missing = json.loads(output.splitlines()[-1]) if code == 0 else (None, "", [])
    except (ValueError, IndexError):
        version = None
    if version is None:
        return "does not work as a Python"
    if tuple(version) not in versions:
        return f"is Python {version[0]}.{version[1]}, which the packages are not pinned for"
    if "venv" in missing:
        hint = f" (on Debian and Ubuntu: python{version[0]}.{version[1]}-venv)" if sys.platform == "linux" else ""
        return f"lacks {' and '.join(missing)}{hint}"
    return BasePython(Path(executable), (version[0], version[1]), "ensurepip" not in missing)
