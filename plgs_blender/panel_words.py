"""What the engine advises, in the panel's words: the panel has a field or a button where a command has an option."""

from __future__ import annotations

import re

FIELDS = {
    "--masks": "Masks",
    "--mask-format": "Mask format",
    "--classes": "Classes",
    "--depth": "Depth maps",
    "--up": "Up",
    "--format": "Format",
    "--preset": "Preset",
    "--set": "All options",
    "--steps": "Steps",
    "--size": "Width and Height",
    "--frames": "Frames",
    "--fit": "Fit memory",
    "--seed": "Seed",
    "--bake": "Bake",
    "--device": "Device",
    "--names-from": "Keep names",
}
"""Options of a lift, by the names of the panel's fields."""
_BUTTONS = {
    "--fix OUT": "Fix",
    "Add --resume": "Press Resume",
    "Add --download": "Allow online access in the preferences",
    "make them: python -m engine segment SCENE": "press Make Masks",
    "'python -m engine presets preview'": "All options",
}
"""What a button or another place of Blender does."""
_WORDS = _BUTTONS | FIELDS
_PATTERN = re.compile("|".join(rf"(?<![\w-]){re.escape(said)}(?![\w-])" for said in _WORDS))


def in_panel_words(text: str) -> str:
    """The text with the panel's own names in place of a command's options."""
    return _PATTERN.sub(lambda found: _WORDS[found[0]], text)
