"""The layouts of captures, as the panel offers them."""

from __future__ import annotations

from ..engine.posed.format_names import MASK_FORMAT_NAMES, SCENE_FORMAT_NAMES

AUTOMATIC = "auto"
"""The choice that lets the format be recognised by the scene's files."""

FORMAT_ITEMS = [
    (AUTOMATIC, "Automatic", "Recognised by the names of the files"),
    *map(tuple, SCENE_FORMAT_NAMES),
]
"""For an EnumProperty."""
MASK_FORMAT_ITEMS = [
    (AUTOMATIC, "Automatic", "Recognised by the names of the files"),
    *map(tuple, MASK_FORMAT_NAMES),
]
"""For an EnumProperty, too."""

FILE_SUFFIXES = (".json", ".txt", ".jsonl", ".sens", ".r3d", ".log", ".bin", ".csv")
"""Files by which people name a scene, in file browsers and by dropping them."""


def label_of(name: str) -> str:
    """What people call a format."""
    return next((each.label for each in SCENE_FORMAT_NAMES if each.name == name), name)


def chosen_format(choice: str) -> str | None:
    """The format that a choice of FORMAT_ITEMS or MASK_FORMAT_ITEMS names; None: it is recognised."""
    return None if choice in ("", AUTOMATIC) else choice
