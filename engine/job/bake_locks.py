"""Several processes that bake one lift at once: who is at work, which view is whose, whose turn it is at the manifest.

The files lie in bake/ in the lift folder and are empty: locks that end with the process that holds them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from uuid import uuid4

from .errors import JobError
from .lock import FileLock, is_locked

MANIFEST_S = 60.0
"""So long a process waits for its turn at the manifest: others hash what they baked in it."""


class BakeLocks:
    """The locks of one process that bakes; for ``with``, around all of its work. Raises OSError."""

    def __init__(self, lift: Path) -> None:
        self._folder = lift / "bake"
        self._own = self._folder / f"process-{uuid4().hex}.lock"
        self._held: FileLock | None = None

    def __enter__(self) -> BakeLocks:
        self._folder.mkdir(exist_ok=True)
        self._held = FileLock(self._own).__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._held is not None
        self._held.__exit__(kind, error, trace)
        self._own.unlink(missing_ok=True)

    def others_at_work(self) -> bool:
        """Whether another process bakes this lift now."""
        return any(is_locked(path) for path in self._folder.glob("process-*.lock") if path != self._own)

    @contextmanager
    def claim(self, view: str) -> Iterator[bool]:
        """Whether this view is for this process to bake, until the ``with`` ends: another may be at it."""
        name = sha256(view.encode()).hexdigest()[:16]  # any text becomes the name of a file
        try:
            lock = FileLock(self._folder / f"view-{name}.lock", wait_s=0.0).__enter__()
        except JobError:
            yield False
            return
        try:
            yield True
        finally:
            lock.__exit__(None, None, None)

    def manifest(self) -> FileLock:
        """The right to change the manifest; for ``with``."""
        return FileLock(self._folder / "manifest.lock", MANIFEST_S)
