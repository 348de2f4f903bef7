"""Find the folder of the user's caches, as this system defines it. Standard library only."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path


def user_cache_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of the user's caches. It may not exist, or be impossible to make if no home is known."""
    places = {"win32": ("LOCALAPPDATA", "AppData/Local"), "darwin": ("", "Library/Caches")}
    variable, below = places.get(sys.platform, ("XDG_CACHE_HOME", ".cache"))
    try:
        return given if (given := Path(environ.get(variable) or "")).is_absolute() else Path.home() / below
    except RuntimeError:  # nobody knows a home, as in a container that runs with a number which no user has
        return Path(os.devnull) / below
