"""The picture of a finding as an image of Blender's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

_NAME = "PLGS finding"


def show(picture: Path, screens: Sequence[bpy.types.Screen]) -> bpy.types.Image:
    """Load a picture, packed as its file goes with the next diagnosis, and show it in the screens' image editors.

    Raises OSError when the file is gone.
    """
    if not picture.is_file():
        raise OSError(f"the picture is gone, diagnose again: {picture}")
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.name = f"{_NAME} {picture.stem}"
    image.pack()
    for screen in screens:
        for area in screen.areas:
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
    return image
