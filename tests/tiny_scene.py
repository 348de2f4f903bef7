"""A scene small enough for unit tests: a box room with a chair and a cabinet (two boxes), ray-traced.

``write_tiny_scene`` writes the folders a user would have. Geometry, labels and poses are exact; depth is
rounded to millimetres and colour to bytes. Everything follows from the arguments: same arguments, same bytes.

The room spans x 0..4, y 0..3, z 0..2.5 metres, z up. Class ids are those of Panoptic Lifting's reduced table in
every layout: 1 wall, 2 floor, 3 cabinet, 5 chair, 13 ceiling. True instances: 1 the chair, 2 the cabinet (a thing
in the COCO masks and in the ground truth).
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]])
CHAIR = np.array([[1.2, 1.0, 0.0], [1.8, 1.6, 0.9]])
CABINET = np.array([[2.3, 1.4, 0.0], [3.0, 1.9, 1.2]])
WALL_ID, FLOOR_ID, CABINET_ID, CHAIR_ID, CEILING_ID = 1, 2, 3, 5, 13
THINGS = {CHAIR_ID, CABINET_ID}
CATEGORIES = [
    {"id": WALL_ID, "name": "wall", "isthing": 0, "color": [200, 190, 170]},
    {"id": FLOOR_ID, "name": "floor", "isthing": 0, "color": [120, 90, 60]},
    {"id": CABINET_ID, "name": "cabinet", "isthing": 1, "color": [60, 110, 200]},
    {"id": CHAIR_ID, "name": "chair", "isthing": 1, "color": [210, 70, 60]},
    {"id": CEILING_ID, "name": "ceiling", "isthing": 0, "color": [235, 235, 230]},
]
PAINT = {category["id"]: np.array(category["color"], np.float64) for category in CATEGORIES}


@dataclass(frozen=True, eq=False)
class TinyView:
    """One exact view: colour uint8 [H, W, 3], depth float32 [H, W] metres, class and instance int32 [H, W]."""

    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]


def tiny_intrinsics(size: tuple[int, int]) -> NDArray[np.float64]:
    """K, float64 [3, 3], pixel centres at +0.5, 70 degrees wide, the middle deliberately off."""
    width, height = size
    focal = width / (2.0 * np.tan(np.radians(35.0)))
    return np.array([[focal, 0.0, width * 0.51], [0.0, focal, height * 0.48], [0.0, 0.0, 1.0]])


def tiny_pose(index: int, frames: int) -> NDArray[np.float64]:
    """Camera-to-world, float64 [4, 4], of a view from an orbit in the room, looking at the furniture."""
    step = min(14.0, 360.0 / frames)
    angle = np.radians(200.0 + step * index)
    target = np.array([2.1, 1.45, 0.55])
    eye = np.array([2.0 + 1.75 * np.cos(angle), 1.5 + 1.3 * np.sin(angle), 1.5 + 0.15 * np.sin(2.0 * angle)])
    return looking_at(target, eye)


def looking_at(target: NDArray[np.float64], eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world, float64 [4, 4], of an upright camera at ``eye``: x right, y down, z forward."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def trace_view(pose: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int]) -> TinyView:
    """Shoot one ray through each pixel's centre."""
    width, height = size
    x = (np.arange(width) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (np.arange(height) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1) @ pose[:3, :3].T
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    origin = pose[:3, 3]

    depth, face = box_hits(ROOM, origin, rays, leaving=True)
    semantic = np.choose(np.where(face == 2, 1 + (rays[..., 2] > 0), 0), [WALL_ID, FLOOR_ID, CEILING_ID])
    instance = np.zeros_like(semantic)
    for number, (box, class_id) in enumerate([(CHAIR, CHAIR_ID), (CABINET, CABINET_ID)], start=1):
        near, near_face = box_hits(box, origin, rays, leaving=False)
        hit = near < depth
        depth, face = np.where(hit, near, depth), np.where(hit, near_face, face)
        semantic, instance = np.where(hit, class_id, semantic), np.where(hit, number, instance)

    points = origin + rays * depth[..., None]
    paint = np.zeros((height, width, 3))
    for class_id, colour in PAINT.items():
        paint[semantic == class_id] = colour
    checker = (np.floor(points / 0.25 + 1e-6).astype(int).sum(axis=-1) % 2) * 0.25 + 0.75
    shade = np.array([0.8, 0.65, 1.0])[face] * checker
    return TinyView(
        colour=np.clip(paint * shade[..., None] + 0.5, 0, 255).astype(np.uint8),
        depth=depth.astype(np.float32),
        semantic=semantic.astype(np.int32),
        instance=instance.astype(np.int32),
    )


def write_tiny_scene(
    folder: Path,
    frames: int = 6,
    size: tuple[int, int] = (64, 48),
    *,
    depth_size: tuple[int, int] | None = None,
    mask_size: tuple[int, int] | None = None,
    masks: Literal["coco", "panoptic_lifting", "none"] = "coco",
    noise: float = 0.0,
    depth_noise: float = 0.0,
    seed: int = 0,
    colour_format: Literal["png", "jpg"] = "png",
    ground_truth: bool = True,
    splits: dict[str, list[str]] | None = None,
    up: Literal["z", "y", "-y"] = "z",
    poses: Sequence[NDArray[np.float64]] | None = None,
    shown: Callable[[TinyView, NDArray[np.float64]], TinyView] = lambda view, pose: view,
    seen: Callable[[TinyView, int], TinyView] = lambda view, number: view,
    categories: list[dict[str, Any]] = CATEGORIES,
) -> Path:
    """Write a scene into ``folder`` and return it. Frames are named 0000, 0001, ...

    ``noise`` (0 to 1) is the share of things with a wrong class, and how ragged mask edges are; ``depth_noise`` is a
    share of the depth. ``up`` is the axis of the written poses that points up. ``poses`` replace the orbit. ``shown``
    changes a view at a pose, ``seen`` what the masks see of the view of that number.
    """
    folder = Path(folder)
    random = np.random.default_rng(seed)
    annotations = []
    next_id = 1
    world = _turned(up)
    orbit = [tiny_pose(index, frames) for index in range(frames)]
    for index, pose in enumerate(orbit if poses is None else poses):
        name, view = f"{index:04d}", shown(trace_view(pose, tiny_intrinsics(size), size), pose)
        depth = trace_view(pose, tiny_intrinsics(depth_size), depth_size).depth if depth_size else view.depth
        labels = trace_view(pose, tiny_intrinsics(mask_size), mask_size) if mask_size else view
        _write_image(folder / "color" / f"{name}.{colour_format}", view.colour[..., ::-1])
        if depth_noise:
            depth = depth * (1 + depth_noise * random.standard_normal(depth.shape))
        _write_image(folder / "depth" / f"{name}.png", np.round(depth * 1000.0).astype(np.uint16))
        _write_matrix(folder / "pose" / f"{name}.txt", world @ pose)
        ids, segments = _machine_mask(seen(labels, index), next_id, noise, random)
        next_id += len(segments)
        if masks == "coco":
            rgb = np.stack([ids % 256, ids // 256 % 256, ids // 65536], axis=-1).astype(np.uint8)
            _write_image(folder / "panoptic" / f"{name}.png", rgb[..., ::-1])
            annotations.append({"image_id": name, "file_name": f"{name}.png", "segments_info": segments})
        elif masks == "panoptic_lifting":
            _write_panoptic_lifting(folder, name, ids, segments)
        if ground_truth:
            _write_image(folder / "gt" / "semantic" / f"{name}.png", view.semantic.astype(np.uint8))
            _write_image(folder / "gt" / "instance" / f"{name}.png", view.instance.astype(np.uint16))
    integer_centres = np.eye(4)
    integer_centres[:3, :3] = tiny_intrinsics(size)
    integer_centres[:2, 2] -= 0.5
    _write_matrix(folder / "intrinsic" / "intrinsic_color.txt", integer_centres)
    if masks == "coco":
        _write_json(folder / "panoptic.json", {"annotations": annotations, "categories": categories})
    if splits is not None:
        _write_json(folder / "splits.json", splits)
    return folder


def box_hits(
    box: NDArray[np.float64], origin: NDArray[np.float64], rays: NDArray[np.float64], leaving: bool
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Where rays enter (or leave) a box: ray parameter [H, W], inf for a miss, and the axis of the face."""
    bounds = np.sort((box[:, None, None, :] - origin) / rays, axis=0)
    near, far = bounds[0].max(axis=-1), bounds[1].min(axis=-1)
    if leaving:
        return far, bounds[1].argmin(axis=-1)
    return np.where((near < far) & (near > 0.0), near, np.inf), bounds[0].argmax(axis=-1)


def _machine_mask(
    view: TinyView, first_id: int, noise: float, random: np.random.Generator
) -> tuple[NDArray[np.int32], list[dict[str, object]]]:
    """Segment ids, int32 [H, W], and their COCO entries, as a detector would give them for one view."""
    semantic, instance = view.semantic, view.instance
    if noise > 0.0:
        height, width = semantic.shape
        shift = random.integers(-1, 2, (2, height, width)) * (random.random((height, width)) < noise)
        rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
        columns = np.clip(np.arange(width)[None, :] + shift[1], 0, width - 1)
        semantic, instance = semantic[rows, columns], instance[rows, columns]
    ids = np.zeros(semantic.shape, np.int32)
    segments: list[dict[str, object]] = []
    for pair in np.unique(semantic * 16 + instance).tolist():
        class_id, number = divmod(pair, 16)
        segment_id = first_id + len(segments)
        where = (semantic == class_id) & (instance == number)
        ids[where] = segment_id
        wrong = class_id in THINGS and random.random() < noise
        seen_as = (CHAIR_ID if class_id == CABINET_ID else CABINET_ID) if wrong else class_id
        score = round(float(random.uniform(0.6, 0.8) if wrong else random.uniform(0.8, 1.0)), 4)
        segments.append({"id": segment_id, "category_id": seen_as, "score": score, "area": int(where.sum())})
    return ids, segments


def _write_panoptic_lifting(folder: Path, name: str, ids: NDArray[np.int32], segments: list[dict[str, object]]) -> None:
    """The same mask as m2f_semantics (8 bits) and m2f_instance (16 bits; here a cabinet is stuff)."""
    semantic, instance = np.zeros(ids.shape, np.uint8), np.zeros(ids.shape, np.uint16)
    for segment in segments:
        where = ids == segment["id"]
        semantic[where] = segment["category_id"]
        if segment["category_id"] == CHAIR_ID:
            instance[where] = segment["id"]
    _write_image(folder / "m2f_semantics" / f"{name}.png", semantic)
    _write_image(folder / "m2f_instance" / f"{name}.png", instance)


def _turned(up: str) -> NDArray[np.float64]:
    """The rotation, float64 [4, 4], that takes the z-up room into a world whose ``up`` axis points up."""
    turn = np.eye(4)
    if up == "y":
        turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    elif up == "-y":
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return turn


def _write_image(path: Path, pixels: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix == ".jpg" else []
    if not cv2.imwrite(str(path), np.ascontiguousarray(pixels), quality):
        raise OSError(f"cannot write {path}")


def _write_matrix(path: Path, matrix: NDArray[np.float64]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(repr(float(value)) for value in row) for row in matrix) + "\n")


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content))
