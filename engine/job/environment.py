"""What PLGS keeps in the user's cache, also after the extension is uninstalled: environments and notes."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from ..errors import PlgsError
from ..user_cache import user_cache_folder
from .requirements import Version, digest, pinned_versions

COMPLETE = "complete"
"""The file that is written last in an environment's folder: if it is there, the environment is complete."""


def notes_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """The folder for notes that may be lost: recent lifts, and how fast this computer is. It may be missing.

    It is PLGS_CACHE_DIR, or else ``plgs`` in the user's cache.
    """
    chosen = environ.get("PLGS_CACHE_DIR")
    return Path(chosen).absolute() if chosen else user_cache_folder(environ) / "plgs"


def environments_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """The folder that holds the environments, their log and their lock; it may be missing."""
    return user_cache_folder(environ) / "plgs"


def environment_name(root: Path, version: Version) -> str:
    """The name of the environment for these requirements and this Python. Raises PlgsError if they are missing."""
    return f"engine-{version[0]}.{version[1]}-{digest(root, version)}"


def python_in(environment: Path) -> Path:
    """The Python of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def is_complete(environment: Path) -> bool:
    """Whether the environment was made completely, and its base Python still exists."""
    return (environment / COMPLETE).is_file() and python_in(environment).exists()


def made_environment(root: Path, environ: Mapping[str, str] = os.environ) -> Path | None:
    """The complete environment for these requirements; the one for this Python if there are several."""
    folder = environments_folder(environ)
    if not folder.is_dir():
        return None
    versions = sorted(pinned_versions(root), key=lambda version: version != sys.version_info[:2])
    try:
        environments = [folder / environment_name(root, version) for version in versions]
    except PlgsError:  # a requirements file is missing, so nothing was made from it
        return None
    return next((environment for environment in environments if is_complete(environment)), None)
