"""Export images of every frame: COCO panoptic, class and instance ids as 16-bit PNGs, also under ScanNet's names, and
depth."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import PlgsError
from ..job import write_atomically
from ..passes.baked_view import ShownInstances
from ..passes.previews import instance_picture, semantic_picture
from ..scene import VOID, Camera, ClassTable
from ..scene.pixels import image_bytes
from .source import FinishedLift

Ids = NDArray[np.int32]
MOST_COCO_IDS = 4096  # class and instance ids below this fit into one 24-bit colour
MOST_IDS = 1 << 16  # ids below this fit into 16 bits
LEAST_COVERAGE = 0.5  # alpha below which a pixel gets no depth


def export_coco(lift: FinishedLift, output: Path) -> None:
    """Write COCO panoptic masks of the lift's frames into ``output``. Raises PlgsError for ids above 4095, OSError."""
    shown = lift.views("semantic", "instance")
    views = ((frame.name, layers.semantic, layers.instance, frame.camera) for frame, layers in shown)
    photos = {frame.name: frame.colour_path.name for frame in lift.frames if frame.file_shows_colour}
    write_coco(output, lift.classes, views, {each.id: each.name for each in lift.corrected.instances}, photos)


def write_coco(
    folder: Path,
    classes: ClassTable,
    views: Iterable[tuple[str, Ids, Ids, Camera]],
    names: Mapping[int, str],
    photos: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write ``panoptic.json`` and ``panoptic/<frame>.png`` into ``folder``, and ``instances.json``: the objects again,
    as COCO's instance annotations with run lengths. ``views`` yields frame name, class ids and instance ids, int32 [H,
    W] each, and camera. A segment's id is class * 4096 + instance, so it means the same object in every view. Besides
    COCO's keys, a segment has the ``instance_id`` and the ``name`` of its instance (``names``) or class, and an image
    its ``K`` and ``camera_to_world`` (OpenCV's axes, metres). Its ``file_name`` is that of its photo, if ``photos`` has
    it. Raises PlgsError for ids from 4096 on, OSError."""
    images, annotations, instances = [], [], list[dict[str, object]]()
    for number, (name, semantic, instance, camera) in enumerate(views, start=1):
        if max(int(semantic.max(initial=0)), int(instance.max(initial=0))) >= MOST_COCO_IDS:
            what = f"{name}: class and instance ids must be below {MOST_COCO_IDS} for COCO panoptic"
            raise PlgsError("coco-ids", what, folder, "Export the form instances instead: it holds ids up to 65535.")
        ids = np.where(semantic == VOID, 0, semantic * MOST_COCO_IDS + instance)
        colours = ids.astype("<u4").view(np.uint8).reshape(*ids.shape, 4)[..., :3]  # lowest byte: R
        write_atomically(folder / "panoptic" / f"{name}.png", image_bytes(colours))
        height, width = ids.shape
        images.append({
            "id": number, "file_name": photos.get(name, f"{name}.png"), "width": width, "height": height,
            "K": camera.resized(width, height).K.tolist(), "camera_to_world": camera.camera_to_world.tolist(),
        })  # fmt: skip
        segments = _segments(ids, classes, names)
        shown = [one for one, _ in segments]
        annotations.append({"image_id": number, "file_name": f"{name}.png", "segments_info": shown})
        for one, runs in segments:
            if one["instance_id"]:
                packed = {"size": runs["size"], "counts": runs["counts"].decode()}
                instances.append({**one, "id": len(instances) + 1, "image_id": number, "segmentation": packed})
    categories = [
        {"id": c.id, "name": c.name, "isthing": int(c.is_thing), "color": list(c.colour)} for c in classes.categories
    ]
    for file, found in (("panoptic.json", annotations), ("instances.json", instances)):
        info = {"description": f"A lift, exported by PLGS {__version__}", "version": __version__}
        content = {"info": info, "images": images, "annotations": found, "categories": categories}
        write_atomically(folder / file, json.dumps(content, ensure_ascii=False) + "\n")


def _segments(
    ids: Ids, classes: ClassTable, names: Mapping[int, str]
) -> list[tuple[dict[str, object], dict[str, Any]]]:
    """Return, for each segment in order of id, its COCO entry (id, class, area, box x, y, width, height, instance,
    name) and its run lengths as COCO has them. Things without an instance are a crowd."""
    from pycocotools import mask as rle_tools  # late: no other export needs it

    segments = []
    by_columns = ids.ravel(order="F")  # as run lengths are counted
    begins = np.flatnonzero(np.diff(by_columns, prepend=-1))
    shown, ends = by_columns[begins], np.append(begins[1:], ids.size)
    for segment in np.unique(shown[shown > 0]).tolist():
        edges = np.stack([begins[shown == segment], ends[shown == segment]], axis=1).ravel()
        counts = np.diff(edges[edges < ids.size], prepend=0, append=ids.size)  # a last count is never 0
        runs = rle_tools.frPyObjects({"size": ids.shape, "counts": counts.tolist()}, *ids.shape)
        box = [int(each) for each in rle_tools.toBbox(runs)]
        category, instance = divmod(segment, MOST_COCO_IDS)
        crowd = int(category in classes.thing_ids and not instance)
        name = names.get(instance) or classes[category].name
        segments.append(({
            "id": segment, "category_id": category, "area": int(rle_tools.area(runs)), "bbox": box, "iscrowd": crowd,
            "instance_id": instance, "name": name,
        }, runs))  # fmt: skip
    return segments


def export_label_images(lift: FinishedLift, output: Path) -> None:
    """Write class/<frame>.png and instance/<frame>.png (16 bits, 0 = none), the same in colours in class_colour/ and
    instance_colour/, and labels.json with their meaning. Raises PlgsError for ids that do not fit, OSError."""
    for frame, layers in lift.views("semantic", "instance"):
        pictures = {
            "class": id_bytes(layers.semantic, output),
            "instance": id_bytes(layers.instance, output),
            "class_colour": image_bytes(semantic_picture(layers.semantic, lift.classes)),
            "instance_colour": image_bytes(instance_picture(layers.instance, lift.instances.colours)),
        }
        for folder, content in pictures.items():
            write_atomically(output / folder / f"{frame.name}.png", content)
    write_atomically(output / "labels.json", labels_text(lift.classes, lift.instances))


def export_scannet(lift: FinishedLift, output: Path) -> None:
    """Write label-filt/<frame>.png and instance-filt/<frame>.png, 16 bits, 0 = none, as in ScanNet's own folders, but
    stuff has no instances. labels.tsv names the classes' ids. Raises PlgsError for ids that do not fit, OSError."""
    for frame, layers in lift.views("semantic", "instance"):
        write_atomically(output / "label-filt" / f"{frame.name}.png", id_bytes(layers.semantic, output))
        write_atomically(output / "instance-filt" / f"{frame.name}.png", id_bytes(layers.instance, output))
    lines = ["id\traw_category\tcategory", *(f"{c.id}\t{c.name}\t{c.name}" for c in lift.classes.categories)]
    write_atomically(output / "labels.tsv", "\n".join(lines) + "\n")


def export_depth(lift: FinishedLift, output: Path) -> None:
    """Write <frame>.npy: planar depth float32 [H, W] metres, 0 = none, as ``lift --depth`` reads it. Raises OSError."""
    for frame, layers in lift.views("combined", "depth"):
        depth = np.where(layers.combined[..., 3] >= LEAST_COVERAGE, layers.depth, np.float32(0))
        content = io.BytesIO()
        np.save(content, depth.astype(np.float32), allow_pickle=False)
        write_atomically(output / f"{frame.name}.npy", content.getvalue())


def labels_text(classes: ClassTable, instances: ShownInstances) -> str:
    """Return, as JSON text, what the ids of classes and instances in exported images mean."""
    class_of, colours = instances.class_of or {}, instances.colours
    listed = [
        {"id": one, "name": name, "class_id": class_of.get(one), "colour": colours[one]}
        for one, name in sorted(instances.names.items())
    ]
    content = {"classes": [asdict(category) for category in classes.categories], "instances": listed}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def id_bytes(ids: Ids, output: Path) -> bytes:
    """Return ids int32 [H, W] as a 16-bit PNG. Raises PlgsError for ids from 65536 on."""
    if int(ids.max(initial=0)) >= MOST_IDS:
        fix = "Export the form points instead."
        raise PlgsError("id-too-large", f"the id {int(ids.max())} does not fit into 16 bits", output, fix)
    return image_bytes(ids.astype(np.uint16))
