"""Class and instance ids as 16-bit PNGs: plain ones, and as ScanNet names them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import JobError, write_atomically
from ..passes import PanopticLayers, ShownInstances, instance_picture, png_bytes, semantic_picture
from ..scene import ClassTable, Frame

MOST_IDS = 1 << 16

Views = Iterable[tuple[Frame, PanopticLayers]]


def write_label_images(output: Path, views: Views, classes: ClassTable, instances: ShownInstances) -> None:
    """class/<frame>.png and instance/<frame>.png (16 bits, 0 = none), the same in colours in class_colour/ and
    instance_colour/, and labels.json, which tells what the ids mean. Raises JobError for ids that do not fit, OSError.
    """
    for frame, layers in views:
        name = f"{frame.name}.png"
        write_atomically(output / "class" / name, id_bytes(layers.semantic, output))
        write_atomically(output / "instance" / name, id_bytes(layers.instance, output))
        write_atomically(output / "class_colour" / name, png_bytes(semantic_picture(layers.semantic, classes)))
        in_colours = instance_picture(layers.instance, instances.colours)
        write_atomically(output / "instance_colour" / name, png_bytes(in_colours))
    write_atomically(output / "labels.json", labels_text(classes, instances))


def write_scannet(output: Path, views: Views, classes: ClassTable) -> None:
    """label-filt/<frame>.png and instance-filt/<frame>.png, 16 bits, 0 = none, as in ScanNet's own folders; the ids are
    those of the lift's classes, which labels.tsv names. Raises as ``write_label_images``.

    ScanNet's instance images count the objects of a scene from 1, stuff included; here stuff has none.
    """
    for frame, layers in views:
        write_atomically(output / "label-filt" / f"{frame.name}.png", id_bytes(layers.semantic, output))
        write_atomically(output / "instance-filt" / f"{frame.name}.png", id_bytes(layers.instance, output))
    lines = ["id\traw_category\tcategory", *(f"{c.id}\t{c.name}\t{c.name}" for c in classes.categories)]
    write_atomically(output / "labels.tsv", "\n".join(lines) + "\n")


def labels_text(classes: ClassTable, instances: ShownInstances) -> str:
    """The meaning of the ids, JSON."""
    class_of, colours = instances.class_of or {}, instances.colours
    listed = [
        {"id": one, "name": name, "class_id": class_of.get(one), "colour": colours[one]}
        for one, name in sorted(instances.names.items())
    ]
    content = {"classes": [asdict(category) for category in classes.categories], "instances": listed}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def id_bytes(ids: NDArray[np.int32], output: Path) -> bytes:
    """Ids int32 [H, W] as a PNG of 16 bits. Raises JobError for ids of 65536 or more."""
    import cv2

    if int(ids.max(initial=0)) >= MOST_IDS:
        fix = "Export COCO or points instead."
        raise JobError(f"the id {int(ids.max())} does not fit into 16 bits", output, fix)
    done, data = cv2.imencode(".png", ids.astype(np.uint16))
    if not done:
        raise ValueError(f"cannot encode ids of shape {ids.shape} as PNG")
    return data.tobytes()
