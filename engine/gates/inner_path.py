"""Paths that a file of somebody else's names: they stay below the folder that they are meant for."""

from __future__ import annotations

from pathlib import PurePosixPath, PureWindowsPath


def inner_path(text: str) -> PurePosixPath:
    """A relative path of plain names. Raises ValueError for one that leaves its folder.

    Judged by Windows' rules, which are the wider ones: drives, shares (to look at one sends the user's credentials
    there), both kinds of slashes.
    """
    parts = PureWindowsPath(text)
    if parts.anchor or ".." in parts.parts or not parts.parts or "\0" in text:
        raise ValueError(f"{text!r} leaves the folder")
    return PurePosixPath(text)
