"""Make a scene from Replica's apartment_0, second floor: ``python sample/second_floor.py DATA OUT [--every 2]``.

DATA is a checkout of the public repository Robot-Indoor-Navigation-System by Chialiang86. Its folder
Semantic-Segmentation has 239 rendered RGB-D frames, and the classes that a real network saw in each. The network is
right on 83 % of the pixels (88 % of those whose class is known); many of the 101 classes are rare or never seen. In OUT
they are masks: each class of stuff is a segment, and so is each connected piece of a class of things. z points up.

OUT's ``gt`` is for the metrics. DATA has a class for each pixel and a box for each object. A pixel belongs to the
object of its class in whose box it lies. 3.5 % of the pixels have two such objects, 5 % have no class (``Objects``).

The Replica Dataset Research Terms allow local measurements only: never commit the pictures, nor anything made of them.
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
from scene_files import (
    PlgsError,
    Segments,
    mask_pixels,
    new_scene,
    read_image,
    run_on_data,
    write_image,
    write_intrinsics,
    write_mask_table,
    write_split,
)
from scipy import ndimage
from scipy.spatial.transform import Rotation

from engine.scene import Camera

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

EVERY = 2
SIDE, FOCAL, MIDDLE = 512, 256.0, 255.5
"""Pixels: the pictures' width and height, focal length and principal point, for pixel centres at whole numbers."""
FARTHEST = 10.0
"""Metres that a stored depth of 65535 means."""
SMALLEST_SEGMENT = 100
"""Pixels."""
INSIDE = 0.01
"""Metres outside a box within which a point still counts as inside."""
THINNEST = 0.02
"""Least metres of a box's side when boxes are compared by volume."""
FIRST_HELD_OUT, HELD_OUT_EVERY = 3, 8
EVERY_FOR_PALETTE = 4
"""Each such picture votes for the classes' colours."""
FLOOR = "second_floor"
FLOORS = ("first_floor", FLOOR)
STUFF = frozenset(
    {"wall", "floor", "ceiling", "window", "door", "blinds", "curtain", "rug", "mat", "beam", "pillar", "stair"}
    | {"handrail", "panel", "vent"}
)
FIX = "Give a checkout of Robot-Indoor-Navigation-System."

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Rotates a world whose y points up."""
OPENGL = np.diag([1.0, -1, -1, 1])
"""Converts between the axes of OpenCV's cameras and OpenGL's."""


@dataclass(frozen=True, eq=False)
class Objects:
    """N objects with a box each. ``class_of`` int64 is indexed by id, 0 = no class.

    ``turns`` float64 [N, 3, 3] rotate a box's own axes to the world's. ``middles`` and ``sizes`` [N, 3] are along its
    own axes, ``places`` [N, 3] are in the world.
    """

    ids: Ints
    class_of: Ints
    places: Floats
    turns: Floats
    middles: Floats
    sizes: Floats

    @property
    def stored_classes(self) -> Ints:
        """The class that DATA's pictures of classes have for each object, int64 [N].

        Ids were cut to 8 bits when these were written, so the class is that of the object whose id is the remainder.
        """
        return self.class_of[self.ids % 256]

    def truth(self, stored: NDArray[np.uint8], points: Floats, measured: NDArray[np.bool_]) -> tuple[Ints, Ints]:
        """Classes and instances, int64 [H, W], 0 = none, for a picture of classes and its points [H, W, 3]."""
        instances = np.zeros(stored.shape, np.int64)
        for class_id in np.unique(stored[stored > 0]):
            here = (stored == class_id) & measured
            able = np.flatnonzero(self.stored_classes == class_id)
            if len(able):
                instances[here] = self.ids[able][self.best(points[here], able)]
        classes = np.where(instances > 0, self.class_of[instances], 0)
        return classes, np.where(classes > 0, instances, 0)

    def best(self, points: Floats, able: Ints) -> Ints:
        """The object among ``able`` with the smallest box around each of the points [P, 3], else with the nearest box:
        its place in ``able``, int64 [P].
        """
        outside = np.stack([self.outside(points, index) for index in able], 1)
        volumes = np.prod(np.maximum(self.sizes[able], THINNEST), axis=1)
        return np.where(outside < INSIDE, volumes, 1e6 + outside).argmin(1)

    def outside(self, points: Floats, index: int) -> Floats:
        """How far points [P, 3] lie outside a box along the worst axis, float64 [P]; negative inside."""
        own = (points - self.places[index]) @ self.turns[index] - self.middles[index]
        return (np.abs(own) - self.sizes[index] / 2).max(1)


class Apartment(NamedTuple):
    """The classes' ``names`` by id, the objects, and a ``palette``: the class of each colour (packed as 0xBBGGRR)."""

    names: dict[int, str]
    objects: Objects
    palette: dict[int, int]

    def is_thing(self, class_id: int) -> int:
        """1 for a thing, 0 for stuff."""
        return int(self.names.get(class_id) not in STUFF)

    @property
    def categories(self) -> list[dict[str, object]]:
        return [{"id": key, "name": name, "isthing": self.is_thing(key)} for key, name in sorted(self.names.items())]


def make_scene(data: Path, out: Path, every: int) -> int:
    """Write the scene as a whole or not at all, and return the number of its frames. Raises PlgsError, OSError."""
    floors = data / "Semantic-Segmentation/Data_collection"
    poses = read_poses(floors / FLOOR / "GT_Pose.txt")
    names, objects = read_info(data / "Semantic-Segmentation/info_semantic.json")
    with new_scene(out):
        apartment = Apartment(names, objects, read_palette(floors))
        write_intrinsics(out, FOCAL, (MIDDLE, MIDDLE))
        numbers = range(1, len(poses) + 1, every)  # of DATA's pictures
        masks = {
            f"{place:04d}": add_frame(floors / FLOOR, number, poses[number - 1], apartment, out, f"{place:04d}")
            for place, number in enumerate(numbers)
        }
        write_mask_table(out / "panoptic.json", masks, apartment.categories)
        write_split(out, [*masks], range(FIRST_HELD_OUT, len(masks), HELD_OUT_EVERY))
    return len(numbers)


def add_frame(floor: Path, number: int, pose: Floats, apartment: Apartment, out: Path, name: str) -> Segments:
    """Write one frame, and return its segments. ``number`` is DATA's, ``name`` the scene's."""
    picture = f"{number}.png"
    depth = read_picture(floor / "depth" / picture, np.uint16).astype(np.float64) / 65535 * FARTHEST
    stored = read_picture(floor / "semantic" / picture)
    points = Camera(SIDE, SIDE, FOCAL, FOCAL, MIDDLE + 0.5, MIDDLE + 0.5, pose).unproject(depth)
    classes, instances = apartment.objects.truth(stored, points, depth > 0)
    ids, segments = segmented(read_seen(floor / "semantic_2" / picture, apartment.palette), apartment)

    photo = read_picture(floor / "rgb" / picture, channels=3)
    write_image(out / f"color/{name}.jpg", photo, (cv2.IMWRITE_JPEG_QUALITY, 95))
    write_image(out / f"depth/{name}.png", (depth * 1000).round().astype(np.uint16))
    np.savetxt(out / f"pose/{name}.txt", pose)
    write_image(out / f"gt/semantic/{name}.png", classes.astype(np.uint8))
    write_image(out / f"gt/instance/{name}.png", instances.astype(np.uint16))
    write_image(out / f"panoptic/{name}.png", mask_pixels(ids))
    return segments


def segmented(classes: Ints, apartment: Apartment) -> tuple[Ints, Segments]:
    """The mask for what a network saw: segment ids, int64 [H, W], 0 = void, and its segments."""
    ids = np.zeros(classes.shape, np.int64)
    segments: Segments = []
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
    """The classes' names by id, and the objects. Raises PlgsError."""
    try:
        info: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        names = {int(entry["id"]): str(entry["name"]) for entry in info["classes"]}
        entries = sorted(info["objects"], key=lambda entry: int(entry["id"]))
        boxes = [entry["oriented_bbox"] for entry in entries]
        objects = Objects(
            np.array([int(entry["id"]) for entry in entries]),
            np.maximum(np.array(info["id_to_label"], np.int64), 0),  # -1 and -2 are not classes either
            rows_of([box["orientation"]["translation"] for box in boxes], 3),
            Rotation.from_quat(rows_of([box["orientation"]["rotation"] for box in boxes], 4)).as_matrix(),
            rows_of([box["abb"]["center"] for box in boxes], 3),
            rows_of([box["abb"]["sizes"] for box in boxes], 3),
        )
        if not 0 < objects.ids.min() <= objects.ids.max() < len(objects.class_of):
            raise ValueError("an object without a class")
    except OSError as error:
        raise PlgsError("there is no readable list of classes and objects", path, FIX) from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise PlgsError("this is not the expected list of classes and objects", path, FIX) from error
    return names, objects


def rows_of(numbers: list[list[float]], columns: int) -> Floats:
    """Float64 [N, columns]. Raises ValueError."""
    rows = np.array(numbers, np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise ValueError(f"not {columns} numbers each")
    return rows


def read_poses(path: Path) -> list[Floats]:
    """All frames' poses: camera-to-world, float64 [4, 4], OpenCV's axes, z up. Raises PlgsError.

    A line has x y z and qw qx qy qz, for a camera with OpenGL's axes in a world whose y points up.
    """
    try:
        rows = np.loadtxt(path, ndmin=2)
        turns = Rotation.from_quat(rows[:, [4, 5, 6, 3]]).as_matrix()
    except (OSError, ValueError, IndexError) as error:
        raise PlgsError("there are no readable poses", path, FIX) from error
    if rows.shape[1] != 7 or not np.isfinite(rows).all():
        raise PlgsError("this is not a table of 7 numbers per frame", path, FIX)
    poses = []
    for row, turn in zip(rows, turns, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, row[:3]
        poses.append(Z_UP @ (pose @ OPENGL))
    return poses


def read_palette(floors: Path) -> dict[int, int]:
    """The class of each packed colour. Raises PlgsError.

    DATA has true classes as numbers and as colours, which differ in 0.04 % of the pixels. So each class in a picture
    votes, with its pixels, for the colour that it mostly has there.
    """
    votes: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for floor in FLOORS:
        folder = floors / floor / "semantic"
        paths = sorted(folder.glob("*.png"))[::EVERY_FOR_PALETTE]
        if not paths:
            raise PlgsError("there are no pictures of classes", folder, FIX)
        for path in paths:
            classes = read_picture(path)
            colours = packed(read_picture(floors / floor / "semantic_gt" / path.name, channels=3))
            for class_id in np.unique(classes):
                found, counts = np.unique(colours[classes == class_id], return_counts=True)
                votes[int(found[counts.argmax()])][int(class_id)] += int(counts.max())
    return {colour: counts.most_common(1)[0][0] for colour, counts in votes.items()}


def read_seen(path: Path, palette: dict[int, int]) -> Ints:
    """The classes that the network saw, int64 [H, W], 0 = none. Raises PlgsError."""
    colours, which = np.unique(packed(read_picture(path, channels=3)), return_inverse=True)
    return np.array([palette.get(colour, 0) for colour in colours.tolist()])[which].reshape(SIDE, SIDE)


def packed(picture: NDArray[Any]) -> Ints:
    """A number for each colour, int64 [H, W], from bytes [H, W, 3] in OpenCV's order."""
    blue, green, red = np.moveaxis(picture.astype(np.int64), -1, 0)
    return blue << 16 | green << 8 | red


def read_picture(path: Path, kind: type[np.generic] = np.uint8, channels: int = 1) -> NDArray[Any]:
    """Pixels of a square picture, [H, W] or B, G, R [H, W, 3]. Raises PlgsError."""
    return read_image(path, kind, (SIDE, SIDE), FIX, channels)


if __name__ == "__main__":
    data = "a checkout of Robot-Indoor-Navigation-System"
    sys.exit(run_on_data(make_scene, __doc__ or "", data, EVERY, "its pictures are for local measurements only"))
