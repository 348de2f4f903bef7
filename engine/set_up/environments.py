"""The folder of environments: what it may hold, and how it is deleted."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..errors import PlgsError
from ..job.environment import environments_folder
from ..job.lock import is_locked

LOG, LOCK = "set-up.log", "set-up.lock"
DOWNLOADS, PYTHON = "downloads", "python"
"""The folders of uv: what it unpacked for an unfinished environment, and the Pythons that it downloaded."""
_TRASH = "trash-"


def throw_away(path: Path, folder: Path) -> None:
    """Move a file or folder aside in ``folder``, on the same disk, to be deleted by `empty_trash`. This is instant. A
    missing file is ignored. Raises OSError; on Windows, also while a program in it still runs."""
    if not path.exists() and not path.is_symlink():
        return
    number = 0
    while (target := folder / f"{_TRASH}{number}").exists():
        number += 1
    path.rename(target)


def empty_trash(folder: Path) -> None:
    """Delete what `throw_away` moved aside, as far as possible. This takes seconds."""
    for path in sorted(folder.glob(f"{_TRASH}*")):
        shutil.rmtree(path, ignore_errors=True)


def refuse_others(folder: Path) -> None:
    """Raise PlgsError for a folder that holds files but no earlier set-up, as a set-up might delete somebody else's
    "downloads". PLGS's own folder in the user's cache is always allowed."""
    is_ours = (folder / LOCK).is_file() or folder == environments_folder()
    if not is_ours and folder.is_dir() and any(path.name[:3] != "uv-" for path in folder.iterdir()):
        fix = "Name a new or an empty folder, or that of an earlier set-up."
        raise PlgsError("folder-used", "the folder holds other files", folder, fix)


def remove_environments(folder: Path) -> None:
    """Delete a set-up's environments in ``folder``, and its downloads. Raises PlgsError while a set-up runs, and for a
    folder that no set-up made; OSError."""
    refuse_others(folder)
    if is_locked(folder / LOCK):
        raise PlgsError("being-set-up", "the engine is being set up", folder, "Wait until it is done, or cancel it.")
    for environment in sorted(folder.glob("engine-*")):
        if (environment / "pyvenv.cfg").is_file():  # other folders may have such a name
            throw_away(environment, folder)
    for path in (folder / DOWNLOADS, folder / PYTHON, *folder.glob("uv-*")):
        throw_away(path, folder)
    empty_trash(folder)
