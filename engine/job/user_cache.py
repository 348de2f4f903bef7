"""The user's cache folder for what PLGS may forget: which lifts there were, how fast this machine is."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path


def user_cache_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """PLGS_CACHE_DIR, else ``plgs`` where this system keeps caches. It may not be there yet."""
    chosen = environ.get("PLGS_CACHE_DIR")
    if chosen:
        return Path(chosen).absolute()
    if sys.platform == "win32":
        base = environ.get("LOCALAPPDATA")
        return (Path(base) if base else Path.home() / "AppData" / "Local") / "plgs"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "plgs"
    base = environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "plgs"
