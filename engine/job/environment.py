"""The packages that the engine needs, as pinned in ``requirements/``, and the folders in the user's cache that hold
environments and notes, which remain when the extension is uninstalled."""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from ..errors import PlgsError, reading
from ..user_cache import user_cache_folder

COMPLETE = "complete"
"""The file that is written last in an environment's folder: if it is there, the environment is complete."""


def notes_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder for notes that may be lost: recent lifts, and how fast this computer is. It may not exist. It
    is the variable PLGS_CACHE_DIR, or else ``plgs`` in the user's cache."""
    chosen = environ.get("PLGS_CACHE_DIR")
    return Path(chosen).absolute() if chosen else user_cache_folder(environ) / "plgs"


def environments_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder that holds the environments, their log and their lock; it may not exist."""
    return user_cache_folder(environ) / "plgs"


def environment_name(root: Path, version: Version) -> str:
    """The name of the environment for these requirements and this Python. Raises PlgsError if they are missing."""
    return f"engine-{version[0]}.{version[1]}-{digest(root, version)}"


def python_in(environment: Path) -> Path:
    """Return the path of Python in a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def is_complete(environment: Path) -> bool:
    """Whether the environment was made completely, and its base Python still exists."""
    return (environment / COMPLETE).is_file() and python_in(environment).exists()


def made_environment(root: Path, environ: Mapping[str, str] = os.environ) -> Path | None:
    """Return a complete environment for these requirements, if possible for this Python's version; None without any."""
    folder = environments_folder(environ)
    if not folder.is_dir():
        return None
    versions = sorted(pinned_versions(root), key=lambda version: version != sys.version_info[:2])  # False is first
    try:
        environments = [folder / environment_name(root, version) for version in versions]
    except PlgsError:  # a requirements file is missing, so nothing was made from it
        return None
    return next((environment for environment in environments if is_complete(environment)), None)


_FILES = ("torch.txt", "engine.txt")
_MODULES = {"open3d-cpu": "open3d", "opencv-contrib-python-headless": "cv2"}
_MARKER = re.compile(r'(sys_platform|python_version) (==|!=|<|>=) "([^"]+)"')

Version = tuple[int, int]
"""A Python's version, such as (3, 11)."""


def module_of(package: str) -> str:
    """Return the name under which a package is imported."""
    return _MODULES.get(package, package)


def pinned_versions(root: Path) -> tuple[Version, ...]:
    """Return the versions of Python for which packages are pinned, the oldest first."""
    names = (path.stem.partition("-")[2] for path in (root / "requirements").glob("constraints-*.txt"))
    return tuple(sorted((int(major), int(minor)) for major, _, minor in (name.partition(".") for name in names)))


def requirement_file(root: Path, name: str, version: Version | None = None) -> Path:
    """Return the path of a file in requirements/, which may be missing. "constraints" of a version pins dependencies.
    "hashes" of a version has the SHA-256 of all packages but torch, "hashes-torch" those of torch, and "hashes-NAME"
    those of the packages that `engine add NAME` installs."""
    ending = "" if version is None else f"-{version[0]}.{version[1]}"
    return root / "requirements" / f"{name}{ending}.txt"


def needed_packages(root: Path, version: Version, platform: str = sys.platform) -> dict[str, str | None]:
    """The needed packages with their pinned versions, torch first; None for an unpinned one. Raises PlgsError if a file
    of requirements is missing."""
    needed: dict[str, str | None] = {}
    for name in _FILES:
        needed |= _pins(root / "requirements" / name, version, platform)
    constraints = requirement_file(root, "constraints", version)
    numpy = _pins(constraints, version, platform).get("numpy") if constraints.exists() else None
    return needed | {"numpy": numpy}


def pinned_hashes(path: Path) -> Iterator[tuple[str, str | None, str]]:
    """Yield each wheel's name, version and SHA-256 in a file of hashes. Raises PlgsError if it cannot be read."""
    name = version = ""
    for line in _text(path).splitlines():
        if pin := re.match(r"([\w.-]+)==([^\s;]+)", line):
            name, version = pin[1].lower().replace("_", "-"), pin[2]
        for each in re.findall("sha256:([0-9a-f]{64})", line):
            yield name, version, each


def digest(root: Path, version: Version) -> str:
    """Return a text that changes with the requirements for a Python version. Raises PlgsError if a file is missing."""
    paths = [root / "requirements" / name for name in _FILES] + [requirement_file(root, "constraints", version)]
    return hashlib.sha256("\n".join(_text(path) for path in paths).encode()).hexdigest()[:12]


def _pins(path: Path, version: Version, platform: str) -> dict[str, str]:
    pins = {}
    for line in _text(path).splitlines():
        requirement, _, marker = line.partition(";")
        name, _, pin = requirement.strip().partition("==")
        if pin and (not marker or _holds(marker.strip(), version, platform, path)):
            pins[name] = pin
    return pins


def _holds(marker: str, version: Version, platform: str, path: Path) -> bool:
    """Whether an environment marker (PEP 508) applies. Only those kinds that our files use are known."""
    match = _MARKER.fullmatch(marker)
    if match is None:
        what = f"has a condition that is not understood ({marker})"
        raise PlgsError("odd-condition", what, path, "Write it like the other lines.")
    subject, operator, text = match.groups()
    if subject == "sys_platform":
        return (platform == text) is (operator == "==")
    bound = tuple(int(part) for part in text.split("."))
    return {"==": version == bound, "!=": version != bound, "<": version < bound, ">=": version >= bound}[operator]


def _text(path: Path) -> str:
    with reading(path, "Reinstall PLGS."):
        return path.read_text(encoding="utf-8")
