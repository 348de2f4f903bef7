"""Compute a digest of the running code, which results and workers report."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_SOURCES = ("*.py", "*.csv")
_LOCKS = ("constraints-*.txt", "hashes-3*.txt")


@cache
def code_digest(*folders: str, root: Path = ROOT) -> str:
    """Return eight hexadecimal digits that change with the Python files and tables in ``folders`` of ``root``, and with
    the lock files in requirements/. Raises OSError."""
    digest = hashlib.sha256()
    sources = [path for folder in folders for kind in _SOURCES for path in (root / folder).rglob(kind)]
    locks = [path for pattern in _LOCKS for path in (root / "requirements").glob(pattern)]
    for path in (*sorted(sources), *sorted(locks)):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:8]
