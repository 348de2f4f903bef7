"""Numba, set up for us: where compiled code is kept, and ``compiled``, the decorator of every kernel.

Import this before numba: the cache folder is read when numba is first imported.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path


def _user_cache_folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return Path(base) if base else Path.home() / "AppData" / "Local"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) if base else Path.home() / ".cache"


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def choose_cache_folder() -> Path:
    """Where compiled kernels are kept: the user's own setting, else the user's cache folder, else a temporary one."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen)
    folder = _user_cache_folder() / "plgs" / "numba"
    if not _writable(folder):
        folder = Path(tempfile.gettempdir()) / "plgs-numba"
        folder.mkdir(parents=True, exist_ok=True)
    return folder


CACHE_FOLDER = choose_cache_folder()
os.environ.setdefault("NUMBA_CACHE_DIR", str(CACHE_FOLDER))

import numba  # noqa: E402

if not numba.config.CACHE_DIR:  # numba was imported before us
    numba.config.CACHE_DIR = str(CACHE_FOLDER)

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
"""No fused multiply-add and no reassociation: the two passes must agree on every weight, bit for bit."""

contracted = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
"""For sums of products that only one pass makes: multiply-add may be fused."""
