"""Make a scene of Replica's apartment_0, second floor: ``python sample/second_floor.py DATA OUT [--every 2]``.

DATA is a checkout of the public repository Robot-Indoor-Navigation-System by Chialiang86, whose folder
Semantic-Segmentation is read: 239 rendered RGB-D frames, and the classes that a real network saw in each. It is right
on 83 % of the pixels (88 % of those whose class is known); of the 101 classes many are rare or never seen. OUT has them
as masks: each class of stuff is a segment, and so is each connected piece of a class of things. Its z points up.

OUT's ``gt`` is for the metrics. DATA has a class for each pixel and a box for each object: a pixel is of the object of
its class in whose box it lies. 3.5 % of the pixels have two such objects, 5 % have no class (``Objects``).

The pictures are under the Replica Dataset Research Terms, for local measurements only: never commit them, nor anything
made of them.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from public_data import BadInput, new_scene, run, write_image
from scipy import ndimage
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

EVERY = 2
SIDE, FOCAL, MIDDLE = 512, 256.0, 255.5
"""Of the pictures, in pixels; whole numbers are pixels' centres."""
FARTHEST = 10.0
"""Metres, of a depth that is stored as 65535."""
SMALLEST_SEGMENT = 100
INSIDE = 0.01
"""A point so many metres outside a box still counts as inside."""
THINNEST = 0.02
"""Metres that a side of a box has at least, when boxes are compared by volume."""
FIRST_HELD_OUT, HELD_OUT_EVERY = 3, 8
EVERY_FOR_PALETTE = 4
FLOOR = "second_floor"
FLOORS = ("first_floor", FLOOR)
FOLDERS = ("color", "depth", "pose", "intrinsic", "panoptic", "gt/semantic", "gt/instance")
STUFF = frozenset(
    {"wall", "floor", "ceiling", "window", "door", "blinds", "curtain", "rug", "mat", "beam", "pillar", "stair"}
    | {"handrail", "panel", "vent"}
)
FIX = "Give a checkout of Robot-Indoor-Navigation-System."

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From a world whose y points up."""
OPENGL = np.diag([1.0, -1, -1, 1])
"""From the axes of OpenCV's cameras to those of OpenGL's."""


@dataclass(frozen=True, eq=False)
class Objects:
    """N objects, a box each: ``turns``, float64 [N, 3, 3], are from its own axes to the world's, ``middles`` and
    ``sizes`` [N, 3] are along its own, ``places`` [N, 3] are in the world."""

    ids: Ints
    class_of: Ints
    """Of an id, int64; 0 = no class."""
    places: Floats
    turns: Floats
    middles: Floats
    sizes: Floats

    @property
    def stored_classes(self) -> Ints:
        """What DATA's pictures of classes have for each object, int64 [N].

        Ids were cut to 8 bits when these were written: they hold the class of the object whose id is the remainder.
        """
        return self.class_of[self.ids % 256]

    def truth(self, stored: NDArray[np.uint8], points: Floats, measured: NDArray[np.bool_]) -> tuple[Ints, Ints]:
        """Classes and instances, int64 [H, W], 0 = none, of a picture of classes and its points [H, W, 3]."""
        instances = np.zeros(stored.shape, np.int64)
        for class_id in np.unique(stored[stored > 0]):
            here = (stored == class_id) & measured
            able = np.flatnonzero(self.stored_classes == class_id)
            if len(able):
                instances[here] = self.ids[able][self.best(points[here], able)]
        classes = np.where(instances > 0, self.class_of[instances], 0)
        return classes, np.where(classes > 0, instances, 0)

    def best(self, points: Floats, able: Ints) -> Ints:
        """For each of the points [P, 3] which of the objects ``able`` has the smallest box around it, else the nearest;
        int64 [P]."""
        outside = np.stack([self.outside(points, index) for index in able], 1)
        volumes = np.prod(np.maximum(self.sizes[able], THINNEST), axis=1)
        return np.where(outside < INSIDE, volumes, 1e6 + outside).argmin(1)

    def outside(self, points: Floats, index: int) -> Floats:
        """How far points [P, 3] lie outside a box along the axis where this is most, float64 [P]; inside it is < 0."""
        own = (points - self.places[index]) @ self.turns[index] - self.middles[index]
        return (np.abs(own) - self.sizes[index] / 2).max(1)


class Apartment(NamedTuple):
    """``names`` of the classes by id, the objects, and the class of each colour (packed: 0xBBGGRR) in pictures."""

    names: dict[int, str]
    objects: Objects
    palette: dict[int, int]

    def is_thing(self, class_id: int) -> int:
        """1 or 0, as COCO has it."""
        return int(self.names.get(class_id) not in STUFF)

    @property
    def categories(self) -> list[dict[str, object]]:
        return [{"id": key, "name": name, "isthing": self.is_thing(key)} for key, name in sorted(self.names.items())]


def make_scene(data: Path, out: Path, every: int) -> int:
    """Write the scene and return how many frames it has.

    Raises BadInput, and OSError when OUT cannot be written. Nothing is left of a scene that could not be made whole.
    """
    floors = data / "Semantic-Segmentation/Data_collection"
    poses = read_poses(floors / FLOOR / "GT_Pose.txt")
    names, objects = read_info(data / "Semantic-Segmentation/info_semantic.json")
    with new_scene(out, FOLDERS):
        apartment = Apartment(names, objects, read_palette(floors))
        intrinsics = np.array([[FOCAL, 0, MIDDLE, 0], [0, FOCAL, MIDDLE, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        np.savetxt(out / "intrinsic/intrinsic_color.txt", intrinsics)
        numbers = range(1, len(poses) + 1, every)  # of DATA's pictures
        annotations = [
            add_frame(floors / FLOOR, number, poses[number - 1], apartment, out, place)
            for place, number in enumerate(numbers)
        ]
        images = [{"id": place, "file_name": f"{place:04d}.jpg"} for place in range(len(numbers))]
        masks = {"images": images, "annotations": annotations, "categories": apartment.categories}
        (out / "panoptic.json").write_text(json.dumps(masks))
        (out / "splits.json").write_text(json.dumps(splits(len(numbers))))
    return len(numbers)


def splits(frames: int) -> dict[str, list[str]]:
    held_out = range(FIRST_HELD_OUT, frames, HELD_OUT_EVERY)
    train = [place for place in range(frames) if place not in held_out]
    return {"train": [f"{place:04d}" for place in train], "test": [f"{place:04d}" for place in held_out]}


def add_frame(floor: Path, number: int, pose: Floats, apartment: Apartment, out: Path, place: int) -> dict[str, object]:
    """Write one frame, and return its entry in the table of masks. ``number`` is DATA's, ``place`` the scene's."""
    name = f"{place:04d}"
    picture = f"{number}.png"
    depth = read_picture(floor / "depth" / picture, np.uint16).astype(np.float64) / 65535 * FARTHEST
    stored = read_picture(floor / "semantic" / picture)
    classes, instances = apartment.objects.truth(stored, world_points(depth, pose), depth > 0)
    ids, segments = segmented(read_seen(floor / "semantic_2" / picture, apartment.palette), apartment)

    photo = read_picture(floor / "rgb" / picture, channels=3)
    write_image(out / f"color/{name}.jpg", photo, (cv2.IMWRITE_JPEG_QUALITY, 95))
    write_image(out / f"depth/{name}.png", (depth * 1000).round().astype(np.uint16))
    np.savetxt(out / f"pose/{name}.txt", pose)
    write_image(out / f"gt/semantic/{name}.png", classes.astype(np.uint8))
    write_image(out / f"gt/instance/{name}.png", instances.astype(np.uint16))
    write_image(out / f"panoptic/{name}.png", np.stack([ids >> 16, ids >> 8 & 255, ids & 255], -1).astype(np.uint8))
    return {"image_id": place, "file_name": f"{name}.png", "segments_info": segments}


def world_points(depth: Floats, pose: Floats) -> Floats:
    """Where each pixel's point is in the world, float64 [H, W, 3]."""
    row, column = np.mgrid[0:SIDE, 0:SIDE]
    x, y = (column - MIDDLE) / FOCAL * depth, (row - MIDDLE) / FOCAL * depth
    return np.stack([x, y, depth], -1) @ pose[:3, :3].T + pose[:3, 3]


def segmented(classes: Ints, apartment: Apartment) -> tuple[Ints, list[dict[str, int]]]:
    """The mask of what a network saw: segment ids, int64 [H, W], 0 = void, and COCO's ``segments_info``."""
    ids = np.zeros(classes.shape, np.int64)
    segments: list[dict[str, int]] = []
    for class_id in np.unique(classes[classes > 0]).tolist():
        is_thing = apartment.is_thing(class_id)
        whole = classes == class_id
        for pixels in pieces(whole) if is_thing else [whole]:
            area = int(pixels.sum())
            if area >= SMALLEST_SEGMENT:
                number = len(segments) + 1
                ids[pixels] = number
                segments.append({"id": number, "category_id": class_id, "isthing": is_thing, "area": area})
    return ids, segments


def pieces(pixels: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Connected pieces, without specks and threads."""
    labels, count = ndimage.label(ndimage.binary_opening(pixels))
    return [labels == label for label in range(1, count + 1)]


def read_info(path: Path) -> tuple[dict[int, str], Objects]:
    """Names of the classes by id, and the objects. Raises BadInput."""
    try:
        info: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        names = {int(entry["id"]): str(entry["name"]) for entry in info["classes"]}
        entries = sorted(info["objects"], key=lambda entry: int(entry["id"]))
        boxes = [entry["oriented_bbox"] for entry in entries]
        objects = Objects(
            np.array([int(entry["id"]) for entry in entries]),
            np.maximum(np.array(info["id_to_label"], np.int64), 0),  # -1 and -2 are no classes either
            rows_of([box["orientation"]["translation"] for box in boxes], 3),
            Rotation.from_quat(rows_of([box["orientation"]["rotation"] for box in boxes], 4)).as_matrix(),
            rows_of([box["abb"]["center"] for box in boxes], 3),
            rows_of([box["abb"]["sizes"] for box in boxes], 3),
        )
        if not 0 < objects.ids.min() <= objects.ids.max() < len(objects.class_of):
            raise ValueError("an object without a class")
    except OSError as error:
        raise BadInput("there is no list of classes and objects that can be read", path, FIX) from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise BadInput("is no list of classes and objects as it was expected", path, FIX) from error
    return names, objects


def rows_of(numbers: list[list[float]], columns: int) -> Floats:
    """Float64 [N, columns]. Raises ValueError."""
    rows = np.array(numbers, np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise ValueError(f"not {columns} numbers each")
    return rows


def read_poses(path: Path) -> list[Floats]:
    """Of all frames: camera to world, float64 [4, 4], OpenCV's axes, z up. Raises BadInput.

    A line has x y z and qw qx qy qz, of a camera with OpenGL's axes in a world whose y points up.
    """
    try:
        rows = np.loadtxt(path, ndmin=2)
        turns = Rotation.from_quat(rows[:, [4, 5, 6, 3]]).as_matrix()
    except (OSError, ValueError, IndexError) as error:
        raise BadInput("there are no poses that can be read", path, FIX) from error
    if rows.shape[1] != 7 or not np.isfinite(rows).all():
        raise BadInput("is no table of 7 numbers a frame", path, FIX)
    poses = []
    for row, turn in zip(rows, turns, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, row[:3]
        poses.append(Z_UP @ (pose @ OPENGL))
    return poses


def read_palette(floors: Path) -> dict[int, int]:
    """The class of each packed colour. Raises BadInput.

    DATA has true classes as numbers and as colours. Each class in a picture votes for the colour that it mostly has
    there, by pixels: the two differ in a few (0.04 %).
    """
    votes: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for floor in FLOORS:
        folder = floors / floor / "semantic"
        paths = sorted(folder.glob("*.png"))[::EVERY_FOR_PALETTE]
        if not paths:
            raise BadInput("there are no pictures of classes", folder, FIX)
        for path in paths:
            classes = read_picture(path)
            colours = packed(read_picture(floors / floor / "semantic_gt" / path.name, channels=3))
            for class_id in np.unique(classes):
                found, counts = np.unique(colours[classes == class_id], return_counts=True)
                votes[int(found[counts.argmax()])][int(class_id)] += int(counts.max())
    return {colour: counts.most_common(1)[0][0] for colour, counts in votes.items()}


def read_seen(path: Path, palette: dict[int, int]) -> Ints:
    """The classes that the network saw, int64 [H, W], 0 = none. Raises BadInput."""
    colours, which = np.unique(packed(read_picture(path, channels=3)), return_inverse=True)
    return np.array([palette.get(colour, 0) for colour in colours.tolist()])[which].reshape(SIDE, SIDE)


def packed(picture: NDArray[Any]) -> Ints:
    """A number for each colour, int64 [H, W], of bytes [H, W, 3] as OpenCV has them."""
    blue, green, red = np.moveaxis(picture.astype(np.int64), -1, 0)
    return blue << 16 | green << 8 | red


def read_picture(path: Path, kind: type[np.generic] = np.uint8, channels: int = 1) -> NDArray[Any]:
    """Numbers of this kind, [H, W] or, as blue, green and red, [H, W, 3]. Raises BadInput."""
    how = cv2.IMREAD_COLOR if channels == 3 else cv2.IMREAD_UNCHANGED
    picture = cv2.imread(str(path), how) if path.is_file() else None
    if picture is None:
        raise BadInput("there is no picture that can be read", path, FIX)
    shape = (SIDE, SIDE, 3) if channels == 3 else (SIDE, SIDE)
    if picture.dtype != kind or picture.shape != shape:
        bits = 8 * np.dtype(kind).itemsize
        raise BadInput(f"is no picture of {SIDE}x{SIDE} pixels, {channels} x {bits} bits each", path, FIX)
    return picture


if __name__ == "__main__":
    data = "a checkout of Robot-Indoor-Navigation-System"
    sys.exit(run(make_scene, __doc__ or "", data, EVERY, "its pictures are for local measurements only"))
