"""The folder where compiled kernels are kept, which only this user can write to.

Numba's index of the folder is a pickle, and reading a pickle can run code. Anyone who could write there could run code
as this user.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import sys
import tempfile
from pathlib import Path
from stat import S_ISDIR, S_ISVTX, S_IWGRP, S_IWOTH

from ..user_cache import user_cache_folder

log = logging.getLogger("plgs.machine")


def choose_cache_folder(name: str) -> Path:
    """The folder ``name``, made in the first place that is safe: the user's setting, or else the user's cache folder.

    If neither is safe, it is a folder for this process alone. Then every start compiles again, and the log says why.
    """
    setting = os.environ.get("NUMBA_CACHE_DIR")
    bases = [Path(setting).absolute()] if setting else []
    bases.append(user_cache_folder() / "plgs")
    for base in bases:
        reason = _make(base / name)
        if reason is None:
            return base / name
        log.warning("compiled kernels are not kept in %s: %s", base, reason)
    own = Path(tempfile.mkdtemp(prefix="plgs-kernels-"))  # for this user only, with a name that cannot be guessed
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own


def _make(folder: Path) -> str | None:
    """Why kernels cannot be kept in a folder; None if it exists and is safe."""
    try:
        missing = [each for each in (folder, *folder.parents) if not each.exists()]
        for each in reversed(missing):
            each.mkdir(mode=0o700, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return "it cannot be written"
        return why_unsafe(folder)
    except OSError as error:
        return f"{error.filename} cannot be used ({error.strerror})"


def why_unsafe(folder: Path) -> str | None:
    """Who else could write to a folder or replace it; None if only this user and root can.

    Windows manages permissions differently, so nothing is checked there.
    """
    if sys.platform == "win32":
        return None
    for each in (folder, *folder.parents, *folder.resolve().parents):
        found = os.lstat(each)
        is_own = found.st_uid in (0, os.getuid()) if each != folder else found.st_uid == os.getuid()
        if not is_own:
            return f"{each} belongs to another user"
        if each == folder and not S_ISDIR(found.st_mode):
            return f"{each} is not a folder"
        # In a sticky folder, such as /tmp, users cannot replace what belongs to others.
        is_sticky = bool(found.st_mode & S_ISVTX) and each != folder
        if S_ISDIR(found.st_mode) and found.st_mode & (S_IWGRP | S_IWOTH) and not is_sticky:
            return f"others may write to {each} (chmod go-w would mend that)"
    return None
