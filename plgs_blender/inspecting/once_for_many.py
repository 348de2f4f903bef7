"""Many rows of a lift's lists change, and its objects are brought in line once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy


class OnceForMany:
    """Decorates a function that brings a lift's objects in line with its lists: `at_once` it runs once, at the end."""

    def __init__(self, apply: Callable[[bpy.types.Collection], None]) -> None:
        self._apply = apply
        self._waiting: list[str] = []
        """Names of the collections whose rows are being changed."""

    def __call__(self, root: bpy.types.Collection) -> None:
        if root.name not in self._waiting:
            self._apply(root)

    @contextmanager
    def at_once(self, root: bpy.types.Collection) -> Iterator[None]:
        """Change many rows, and bring the objects in line afterwards."""
        self._waiting.append(root.name)
        try:
            yield
        finally:
            self._waiting.pop()
        self(root)
