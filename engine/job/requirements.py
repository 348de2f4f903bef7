"""The packages that the engine needs, as pinned in ``requirements/``. The set-up and the handshake read them."""

from __future__ import annotations

import hashlib
import re
import sys
from pathlib import Path

from ..errors import PlgsError

_FILES = ("torch.txt", "engine.txt")
_MODULES = {"open3d-cpu": "open3d", "opencv-contrib-python-headless": "cv2"}
_MARKER = re.compile(r'(sys_platform|python_version) (==|!=|<|>=) "([^"]+)"')

Version = tuple[int, int]
"""A Python's version, such as (3, 11)."""


def module_of(package: str) -> str:
    """The name under which a needed package is imported."""
    return _MODULES.get(package, package)


def pinned_versions(root: Path) -> tuple[Version, ...]:
    """The versions of Python for which the packages are pinned, the oldest first."""
    names = (path.stem.partition("-")[2] for path in (root / "requirements").glob("constraints-*.txt"))
    return tuple(sorted((int(major), int(minor)) for major, _, minor in (name.partition(".") for name in names)))


def constraints_path(root: Path, version: Version) -> Path:
    """The file that pins the dependencies of the requirements. It may be missing."""
    return root / "requirements" / f"constraints-{version[0]}.{version[1]}.txt"


def hashes_path(root: Path, version: Version) -> Path:
    """The file that lists the SHA-256 of all packages of the engine except torch. It may be missing."""
    return root / "requirements" / f"hashes-{version[0]}.{version[1]}.txt"


def needed_packages(root: Path, version: Version, platform: str = sys.platform) -> dict[str, str | None]:
    """The packages with their pinned versions, torch first; None for one that is not pinned here. Raises PlgsError."""
    needed: dict[str, str | None] = {}
    for name in _FILES:
        needed |= _pins(root / "requirements" / name, version, platform)
    constraints = constraints_path(root, version)
    numpy = _pins(constraints, version, platform).get("numpy") if constraints.exists() else None
    return needed | {"numpy": numpy}


def digest(root: Path, version: Version) -> str:
    """A name for an environment, which changes with the text of the requirements. Raises PlgsError."""
    paths = [root / "requirements" / name for name in _FILES] + [constraints_path(root, version)]
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
    """Whether a condition of our files holds. pip knows more kinds, but may not be installed."""
    match = _MARKER.fullmatch(marker)
    if match is None:
        raise PlgsError(f"has a condition that is not understood ({marker})", path, "Write it like the other lines.")
    subject, operator, text = match.groups()
    if subject == "sys_platform":
        return (platform == text) is (operator == "==")
    bound = tuple(int(part) for part in text.split("."))
    return {"==": version == bound, "!=": version != bound, "<": version < bound, ">=": version >= bound}[operator]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise PlgsError(f"cannot be read ({error.strerror})", path, "Install PLGS again: it is part of it.") from error
