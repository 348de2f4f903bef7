"""A Python that can make the engine's environment: Blender's own, or one that lies on this machine."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...engine.job.requirements import Version

# -I: nothing of the user's, and nothing beside the code, is taken for a part of it.
PROBE = (
    "import importlib.util, json, sys; "
    "lacking = [name for name in ('venv', 'ensurepip') if not importlib.util.find_spec(name)]; "
    "print(json.dumps([sys.version_info[:2], sys.executable, lacking]))"
)
_MORE_FOLDERS = ("/opt/homebrew/bin", "/usr/local/bin", "/usr/bin")
"""A Blender that was started from a dock or menu has a short PATH."""


@dataclass(frozen=True)
class BasePython:
    """A Python that can make environments."""

    python: Path
    version: Version


def candidates(given: Path | None, versions: Sequence[Version]) -> list[Path]:
    """Where to look: the given one only, else this Blender's own, then those of the search path."""
    if given is not None:
        return [given]
    names = [f"python{major}.{minor}" for major, minor in versions] + ["python3", "python"]
    folders = list(dict.fromkeys([*os.get_exec_path(), *([] if os.name == "nt" else _MORE_FOLDERS)]))
    suffix = ".exe" if os.name == "nt" else ""
    found = [Path(folder) / f"{name}{suffix}" for name in names for folder in folders]
    runnable = [path for path in found if path.is_file() and os.access(path, os.X_OK)]
    return list(dict.fromkeys([Path(sys.executable), *runnable]))


def judge(output: str, code: int, versions: Sequence[Version]) -> BasePython | str:
    """What a Python that was asked PROBE can do: it is fit, or why not."""
    try:
        version, executable, missing = json.loads(output.splitlines()[-1]) if code == 0 else (None, "", [])
    except (ValueError, IndexError):
        version = None
    if version is None:
        return "does not work as a Python"
    if tuple(version) not in versions:
        return f"is Python {version[0]}.{version[1]}, which the packages are not pinned for"
    if missing:
        hint = f" (on Debian and Ubuntu: python{version[0]}.{version[1]}-venv)" if sys.platform == "linux" else ""
        return f"lacks {' and '.join(missing)}{hint}"
    return BasePython(Path(executable), (version[0], version[1]))


def wanted(versions: Sequence[Version]) -> str:
    """The Pythons that would do, in words."""
    return " or ".join(f"{major}.{minor}" for major, minor in versions)
