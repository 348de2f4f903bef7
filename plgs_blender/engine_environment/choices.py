"""The user's choices for the engine, kept in the add-on's preferences or, without these, for this session."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy

from ...engine.job.studio import VARIABLE, StudioDefaults, studio_defaults

EXTENSION = __package__.rsplit(".", 2)[0]
"""The extension's name in Blender, under which its preferences are stored."""

TORCH_BUILDS = [
    ("cpu", "CPU", "The small build; enough for lifts on the CPU"),
    ("cuda", "CUDA", "Several GB more; for lifts on an NVIDIA GPU, which also need gsplat"),
]


@dataclass(frozen=True)
class SetUpChoice:
    """What "Set Up Engine" installs: the build of torch ("cpu" or "cuda"), from the package index ``index_url`` ("":
    the usual one), for ``base_python`` (None: this Blender's or another)."""

    base_python: Path | None = None
    torch_build: str = "cpu"
    index_url: str = ""

    def arguments(self) -> list[str | Path]:
        """The choice as arguments of the engine's set-up command."""
        arguments: list[str | Path] = ["--torch", self.torch_build]
        return arguments if self.base_python is None else [*arguments, "--base-python", self.base_python]

    def variables(self) -> dict[str, str]:
        """The choice as environment variables of the engine's set-up command."""
        # The URL may hold a password, which an argument would show in the list of processes.
        return {"PLGS_INDEX_URL": self.index_url} if self.index_url else {}


_session = SimpleNamespace(engine_python="", base_python="", torch_build="cpu", index_url="", defaults_file="")
"""The choices of a session without preferences."""
_file_of_preferences = ""


def chosen_python() -> Path | None:
    """Return the Python chosen with "Use This Python"; None lets PLGS choose."""
    return _path(_choices().engine_python)


def choose(python: Path | None) -> None:
    """Use this Python from now on; None lets PLGS choose again."""
    _choices().engine_python = str(python) if python is not None else ""


def set_up_choice(base_python: str = "", torch_build: str = "", index_url: str = "") -> SetUpChoice:
    """Return what "Set Up Engine" installs; empty arguments are replaced by the preferences."""
    choices = _choices()
    return SetUpChoice(
        _path(base_python or choices.base_python),
        torch_build or choices.torch_build,
        (index_url or choices.index_url).strip(),
    )


def studio() -> StudioDefaults:
    """Return the studio's defaults, from the file that PLGS_DEFAULTS names, else from the one in the preferences, and
    let later engines read it. Raises PlgsError if that file is bad."""
    global _file_of_preferences
    if os.environ.get(VARIABLE, "") == _file_of_preferences:  # not set by the user, who comes first
        _file_of_preferences = os.environ[VARIABLE] = str(_path(_choices().defaults_file) or "")
    return studio_defaults()


def own_python() -> Path:
    """Return the Python that comes with this Blender."""
    return Path(sys.executable)


def _choices() -> Any:
    return preferences() or _session


def preferences() -> bpy.types.AddonPreferences | None:
    """Return the extension's preferences; None if it is not installed."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return addon.preferences if addon is not None else None


def _path(text: str) -> Path | None:
    return Path(bpy.path.abspath(text)) if text.strip() else None
