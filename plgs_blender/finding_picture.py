"""The picture of a finding as an image of Blender's."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import bpy

_NAME = "PLGS finding"


def show(picture: Path, screens: Iterable[bpy.types.Screen]) -> tuple[bpy.types.Image, bool]:
    """Load a picture, packed as its file goes with the next diagnosis, in place of the one of that name, and show it
    in the largest image editor: the image, and whether there is such an editor.

    Raises OSError when the file is gone.
    """
    if not picture.is_file():
        raise OSError(f"the picture is gone, diagnose again: {picture}")
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.pack()
    name = f"{_NAME} {picture.stem}"
    earlier = bpy.data.images.get(name)
    if earlier is not None:
        earlier.user_remap(image)
        bpy.data.images.remove(earlier)
    image.name = name
    editors = [area for screen in screens for area in screen.areas if area.type == "IMAGE_EDITOR"]
    if editors:
        max(editors, key=lambda area: area.width * area.height).spaces.active.image = image
    return image, bool(editors)
