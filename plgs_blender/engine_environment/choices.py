"""What the user chose about the engine: in the add-on's preferences, or, without an installation, for this session."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from .progress import Wish

EXTENSION = __package__.rsplit(".", 2)[0]
"""The name under which Blender knows the extension: its preferences go by it."""

TORCH_BUILDS = [
    ("cpu", "CPU", "The small build, which is all that a lift uses"),
    ("cuda", "CUDA", "Several GB more; only a lift from the command line draws on it, with --device cuda"),
]


@dataclass
class _Session:
    """In the place of preferences."""

    engine_python: str = ""
    base_python: str = ""
    torch_build: str = "cpu"
    index_url: str = ""


_session = _Session()


def chosen_python() -> Path | None:
    """The Python of "Use this Python"; None when it is left to PLGS."""
    return _path(_choices().engine_python)


def choose(python: Path | None) -> None:
    """Use this Python from now on; None leaves it to PLGS again."""
    _choices().engine_python = str(python) if python is not None else ""


def wish(base_python: str = "", torch_build: str = "", index_url: str = "") -> Wish:
    """What "Set up engine" shall make: as given, and as the preferences have it where nothing is given."""
    choices = _choices()
    return Wish(
        _path(base_python or choices.base_python),
        torch_build or choices.torch_build,
        (index_url or choices.index_url).strip(),
    )


def own_python() -> Path:
    """The Python that this Blender brings."""
    return Path(sys.executable)


def are_in_preferences() -> bool:
    """Whether the extension is installed, so that Blender keeps its preferences."""
    return _preferences() is not None


def _choices() -> Any:
    return _preferences() or _session


def _preferences() -> bpy.types.AddonPreferences | None:
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return addon.preferences if addon is not None else None


def _path(text: str) -> Path | None:
    return Path(bpy.path.abspath(text)) if text.strip() else None
