"""What the colours of boxes and points tell, in Solid shading and in renders alike: they are the objects' colours."""

from __future__ import annotations

import bpy

from ..colour import object_colour
from .lookup import boxes_of, clouds_of
from .once_for_many import OnceForMany

BY_INSTANCE, BY_CLASS = "INSTANCE", "CLASS"


@OnceForMany
def apply_colours(root: bpy.types.Collection) -> None:
    """Colour the clouds by their classes and the boxes as the lift's `box_colours` says."""
    lists = root.plgs
    of_class = {row.class_id: _linear(row.colour) for row in lists.classes}
    for cloud in clouds_of(root):
        number = cloud.get("class_id")
        if isinstance(number, int) and number in of_class:
            cloud.color = of_class[number]
    boxes = boxes_of(root)
    for row in lists.instances:
        box = boxes.get(row.instance_id)
        if box is not None:
            own = _linear(row.colour)
            box.color = of_class.get(row.class_id, own) if lists.box_colours == BY_CLASS else own


def _linear(srgb: bpy.types.bpy_prop_array) -> tuple[float, float, float, float]:
    red, green, blue = (round(255.0 * channel) for channel in srgb)
    return object_colour((red, green, blue))
