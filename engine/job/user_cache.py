"""Where PLGS keeps what it may forget: which lifts there were, how fast this machine is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from .environment import user_cache_folder


def notes_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """PLGS_CACHE_DIR, else ``plgs`` in the user's cache. It may not be there yet."""
    chosen = environ.get("PLGS_CACHE_DIR")
    return Path(chosen).absolute() if chosen else user_cache_folder(environ) / "plgs"
