"""Render the sample room: ``python sample/render_room.py HOUSE.glb OUT [--samples N] [--every N]``.

HOUSE.glb is the AWS RoboMaker "small house" as one glTF file: one node for each object, with a property "category". It
is one open floor of 19 x 11 m. The dining table with its chairs, a chandelier and a few more pieces are moved next to
the sofa, so that they make one room. The program writes posed RGB-D frames with ground truth: ``color/ depth/ pose/
intrinsic/ splits.json gt/``. Cycles path-traces colour. Open3D casts depth and ids against the same triangles, so they
are exact. The result is part of the repository: nobody needs to run this program to use the sample. It needs bpy,
open3d and cv2.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import bpy
import cv2
import numpy as np
import open3d as o3d
from mathutils import Matrix
from numpy.typing import ArrayLike, NDArray
from shared import write_image

WIDTH, HEIGHT = 320, 240
FOCAL = WIDTH / 2 / math.tan(math.radians(75) / 2)  # pixels; 75 degrees across, as wide as a phone's camera
FLOOR_TOP = 0.02  # metres; the wall's mesh contains a floor below this height
RAREST = 2000  # pixels; an object with fewer in all frames together becomes void
HELD_OUT_EVERY = 8
JPEG_QUALITY = 92
EXPOSURE = -0.9  # stops
LAMPS = (
    # x, y (metres), diameter (metres), watts
    (0.6, -1.6, 1.6, 110.0),
    (4.65, -2.05, 1.4, 90.0),
    (1.2, 3.6, 2.0, 90.0),
    (7.4, 0.6, 1.4, 60.0),
    (7.4, -3.4, 1.2, 50.0),
    (0.6, -4.4, 1.2, 40.0),
    (-5.5, -3.0, 2.0, 90.0),
    (-5.5, 1.5, 2.0, 90.0),
)

CATEGORIES: tuple[tuple[int, str, bool], ...] = (
    (1, "wall", False),
    (2, "floor", False),
    (3, "ceiling", False),
    (4, "window", False),
    (5, "door", False),
    (6, "rug", False),
    (7, "chair", True),
    (8, "sofa", True),
    (9, "table", True),
    (10, "cabinet", True),
    (11, "shelf", True),
    (12, "bed", True),
    (13, "television", True),
    (14, "lamp", True),
    (15, "picture", True),
    (16, "bin", True),
    (17, "appliance", True),
    (18, "object", True),
)
"""(id, name, is thing). No frame shows the bed, but networks have such a class and sometimes see it."""

CLASS_OF_MODEL: dict[str, str] = {
    "HouseWallB": "wall", "RoomWall": "wall", "FloorB": "floor", "RoomCeiling": "ceiling", "RoomWindow": "window",
    "Curtain": "window", "Door": "door", "FoldingDoor": "door", "Handle": "door", "Carpet": "rug", "ChairA": "chair",
    "ChairD": "chair", "SofaC": "sofa", "KitchenTable": "table", "CoffeeTable": "table", "BalconyTable": "table",
    "ReadingDesk": "table", "TVCabinet": "cabinet", "KitchenCabinet": "cabinet", "Wardrobe": "cabinet",
    "NightStand": "cabinet", "Board": "shelf", "ShoeRack": "shelf", "Bed": "bed", "TV": "television",
    "Chandelier": "lamp", "LightC": "lamp", "PortraitA": "picture", "PortraitB": "picture", "PortraitC": "picture",
    "PortraitD": "picture", "PortraitE": "picture", "Trash": "bin", "AirconditionerA": "appliance",
    "AirconditionerB": "appliance", "Refrigerator": "appliance", "Rangehood": "appliance", "Vase": "object",
    "Tableware": "object", "Tablet": "object", "Dumbbell": "object", "FitnessEquipment": "object",
    "DeskPortraitB": "object",
}  # fmt: skip
"""Class of a model by its "category" property. Models that are missing are in ``STANDS_ON``."""

STANDS_ON: dict[str, str] = {
    "DeskPortraitA_01": "TVCabinet_01_001",
    "DeskPortraitA_02": "CoffeeTable_01_001",
    "DeskPortraitC_01": "NightStand_01_001",
    "DeskPortraitC_02": "CoffeeTable_01_001",
    "DeskPortraitD_01": "Board_01_001",
    "DeskPortraitD_02": "TVCabinet_01_001",
    "DeskPortraitD_03": "CoffeeTable_01_001",
    "DeskPortraitD_04": "ShoeRack_01_001",
    "SecurityCamera_01_001": "TVCabinet_01_001",
    "CookingBench_01_001": "KitchenCabinet_01_001",
    "KitchenUtensils_01_001": "KitchenCabinet_01_001",
    "SeasoningBox_01_001": "KitchenCabinet_01_001",
}
"""Small things, and the larger object that each counts as."""


@dataclass(frozen=True)
class Move:
    """Move an object's origin to ``to`` (x, y, z in metres; None keeps z), and turn it by ``turn`` degrees about z."""

    to: tuple[float, float, float | None]
    turn: float = 0.0


_SET = (-1.9, -3.0)  # the dining set moves as one, chairs and all
MOVES: dict[str, Move] = {
    "KitchenTable_01_001": Move((6.55 + _SET[0], 0.95 + _SET[1], None)),
    "Tableware_01_001": Move((7.15 + _SET[0], 0.98 + _SET[1], None)),
    "ChairA_01_001": Move((7.12 + _SET[0], 0.21 + _SET[1], None)),
    "ChairA_01_002": Move((6.26 + _SET[0], 0.22 + _SET[1], None)),
    "ChairA_01_003": Move((6.07 + _SET[0], 1.68 + _SET[1], None)),
    "ChairA_01_004": Move((7.00 + _SET[0], 1.67 + _SET[1], None)),
    "Vase_01_001": Move((4.25, -2.05, 0.81)),
    "Chandelier_01_003": Move((4.65, -2.05, None)),
    "ChairD_01_001": Move((-0.35, 0.15, None), -50.0),
    "ChairD_01_002": Move((2.95, 0.25, None), 40.0),
    "Trash_01_002": Move((3.55, -4.85, None)),
}

WALK: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    # (eye, target): once around sofa and table, looking in ...
    ((0.2, 1.6, 1.55), (0.7, -2.6, 0.7)),
    ((2.2, 1.7, 1.50), (1.6, -2.6, 0.6)),
    ((4.3, 1.2, 1.55), (3.2, -2.4, 0.6)),
    ((6.1, 0.1, 1.60), (3.8, -2.2, 0.6)),
    ((6.4, -1.9, 1.50), (3.2, -2.1, 0.6)),
    ((5.8, -3.7, 1.45), (2.8, -2.1, 0.6)),
    ((4.2, -4.1, 1.55), (0.6, -2.4, 0.5)),
    ((2.5, -4.2, 1.60), (0.2, -2.2, 0.4)),
    ((0.4, -4.2, 1.65), (0.0, -1.9, 0.3)),
    ((-1.4, -3.8, 1.60), (1.6, -1.9, 0.4)),
    ((-1.8, -2.0, 1.60), (2.3, -2.0, 0.4)),
    ((-1.6, 0.0, 1.60), (1.9, -2.3, 0.4)),
    ((-0.2, 1.2, 1.55), (2.2, -2.2, 0.5)),
    # ... then through the middle, looking around
    ((1.5, 0.9, 1.50), (3.6, -2.3, 0.7)),
    ((2.9, -0.6, 1.45), (4.3, -3.2, 0.7)),
    ((3.0, -1.7, 1.45), (2.9, -5.0, 0.8)),
    ((3.0, -2.7, 1.45), (0.7, -5.3, 0.9)),
    ((2.4, -3.7, 1.50), (-1.2, -4.7, 0.8)),
    ((0.8, -3.9, 1.55), (-2.2, -3.4, 0.8)),
)

STEP_METRES, STEP_DEGREES = 0.8, 15.0
"""The camera moves or turns by this much between two frames. Parts of both add up."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("house", type=Path, help="small_house.glb")
    parser.add_argument("out", type=Path, help="scene folder to write")
    parser.add_argument("--samples", type=int, default=16, help="path-tracing samples per pixel (default 16)")
    parser.add_argument("--every", type=int, default=1, help="render only every N-th frame, to look at the walk")
    parser.add_argument("--seed", type=int, default=0, help="seed of the walk's tremor and of the path tracer")
    options = parser.parse_args()
    load_house(options.house)
    furnish()
    light()
    camera = set_up_camera(options.samples)
    poses = walk(options.seed)[:: options.every]
    caster, objects = build_caster()
    for name in ("color", "depth", "pose", "intrinsic", "gt/semantic", "gt/instance"):
        (options.out / name).mkdir(parents=True, exist_ok=True)
    seen = []
    for index, pose in enumerate(poses):
        depth, ids = cast(caster, objects, pose)
        seen.append(ids)
        write_image(options.out / f"depth/{index:04d}.png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        np.savetxt(options.out / f"pose/{index:04d}.txt", pose, fmt="%.9f")
    lens = np.diag([FOCAL, FOCAL, 1.0, 1.0])
    lens[:2, 2] = WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5  # pixel centres at whole numbers
    np.savetxt(options.out / "intrinsic/intrinsic_color.txt", lens, fmt="%.9f")
    names = [f"{index:04d}" for index in range(len(poses))]
    test = names[::HELD_OUT_EVERY]
    split = {"train": [name for name in names if name not in test], "test": test}
    (options.out / "splits.json").write_text(json.dumps(split, indent=1) + "\n")
    write_ground_truth(options.out, seen)
    for index, pose in enumerate(poses):
        started = time.time()
        photograph(camera, pose, options.seed + index, options.out / f"color/{index:04d}.jpg")
        print(f"frame {index + 1}/{len(poses)}  {time.time() - started:.1f} s", flush=True)


def load_house(path: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))


def furnish() -> None:
    """Move the furniture as MOVES says."""
    for name, move in MOVES.items():
        item = bpy.data.objects[name]
        x, y, z = move.to
        item.matrix_world = (
            Matrix.Translation((x, y, item.matrix_world.translation.z if z is None else z))
            @ Matrix.Rotation(math.radians(move.turn), 4, "Z")
            @ Matrix.Translation(-item.matrix_world.translation)
            @ item.matrix_world
        )
    bpy.context.view_layer.update()


def light() -> None:
    """Soft light from the ceiling and a little from everywhere, instead of the model's bulbs."""
    for lamp in [item for item in bpy.data.objects if item.type == "LIGHT"]:
        bpy.data.objects.remove(lamp)
    for x, y, size, watts in LAMPS:
        data = bpy.data.lights.new("ceiling light", "AREA")
        data.energy, data.shape, data.size, data.color = watts, "DISK", size, (1.0, 0.94, 0.86)
        item = bpy.data.objects.new("ceiling light", data)
        item.location = (x, y, 2.4)
        item.visible_camera = False
        bpy.context.scene.collection.objects.link(item)
    world = bpy.data.worlds.new("room")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.9, 0.95, 1.0, 1.0)
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.3
    bpy.context.scene.world = world


def set_up_camera(samples: int) -> bpy.types.Object:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.max_bounces, scene.cycles.diffuse_bounces = samples, 4, 3
    scene.cycles.use_light_tree = False  # it costs more than it saves with eight lamps
    scene.cycles.use_denoising, scene.cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.view_settings.view_transform, scene.view_settings.look = "AgX", "AgX - Medium High Contrast"
    scene.view_settings.exposure = EXPOSURE
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.render.image_settings.file_format = "JPEG"
    scene.render.image_settings.quality = JPEG_QUALITY
    scene.render.use_persistent_data = True
    data = bpy.data.cameras.new("phone")
    data.sensor_fit, data.angle, data.clip_start = "HORIZONTAL", 2 * math.atan(WIDTH / 2 / FOCAL), 0.02
    camera = bpy.data.objects.new("phone", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def photograph(camera: bpy.types.Object, pose: NDArray[np.float64], seed: int, path: Path) -> None:
    camera.matrix_world = Matrix((pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())  # OpenCV to Blender axes
    bpy.context.scene.cycles.seed = seed
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def build_caster() -> tuple[o3d.t.geometry.RaycastingScene, list[str]]:
    """All triangles of the house for ray casting, and the objects' names by geometry id."""
    caster = o3d.t.geometry.RaycastingScene()
    names: list[str] = []
    for item in bpy.context.scene.objects:
        if item.type != "MESH":
            continue
        mesh = item.data
        corners = np.empty(len(mesh.vertices) * 3, np.float32)
        mesh.vertices.foreach_get("co", corners)
        to_world = np.array(item.matrix_world, np.float64)
        world = corners.reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
        mesh.calc_loop_triangles()
        triangles = np.empty(len(mesh.loop_triangles) * 3, np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles)
        index = caster.add_triangles(
            o3d.core.Tensor.from_numpy(world.astype(np.float32)),
            o3d.core.Tensor.from_numpy(triangles.reshape(-1, 3).astype(np.uint32)),
        )
        assert index == len(names)
        names.append(item.name)
    return caster, names


def cast(
    caster: o3d.t.geometry.RaycastingScene, names: list[str], pose: NDArray[np.float64]
) -> tuple[NDArray[np.uint16], NDArray[np.str_]]:
    """Planar depth, uint16 [H, W] millimetres, 0 = none, and the object's name at each pixel's centre, [H, W]."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], -1) @ pose[:3, :3].T  # length 1 along the optical axis
    origin = np.broadcast_to(pose[:3, 3], rays.shape)
    answer = caster.cast_rays(o3d.core.Tensor.from_numpy(np.concatenate([origin, rays], -1).astype(np.float32)))
    distance, index = answer["t_hit"].numpy(), answer["geometry_ids"].numpy()
    hit = np.isfinite(distance)
    owner = np.array([*names, ""])[np.where(hit, index, len(names))]
    height = pose[2, 3] + rays[..., 2] * np.where(hit, distance, 0.0)
    owner[(owner == "HouseWallB_01_001") & (height < FLOOR_TOP)] = "FloorB_01_001"
    return np.where(hit, np.clip(np.round(distance * 1000), 0, 65535), 0).astype(np.uint16), owner


def write_ground_truth(out: Path, seen: list[NDArray[np.str_]]) -> None:
    """Write class ids and instance ids of the scene (1.. for things, 0 for stuff) as 16-bit PNGs, and their tables."""
    class_id = {name: number for number, name, _ in CATEGORIES}
    is_thing = {number: thing for number, _, thing in CATEGORIES}
    carriers = [np.vectorize(STANDS_ON.get)(ids, ids) for ids in seen]
    names, counts = np.unique(np.stack(carriers), return_counts=True)
    model = {item.name: item.get("category", "") for item in bpy.data.objects}
    class_of = {
        str(name): class_id[CLASS_OF_MODEL[model[name]]] if name and count >= RAREST else 0
        for name, count in zip(names, counts, strict=True)
    }
    things = sorted((name for name, number in class_of.items() if is_thing.get(number)), key=lambda n: (class_of[n], n))
    instance_of = {name: index + 1 for index, name in enumerate(things)}
    for index, whole in enumerate(carriers):
        found, inverse = np.unique(whole, return_inverse=True)
        shape = (HEIGHT, WIDTH)
        semantic = np.array([class_of[str(name)] for name in found], np.uint16)[inverse].reshape(shape)
        instance = np.array([instance_of.get(str(name), 0) for name in found], np.uint16)[inverse].reshape(shape)
        write_image(out / f"gt/semantic/{index:04d}.png", semantic, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        write_image(out / f"gt/instance/{index:04d}.png", instance, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    categories = [{"id": number, "name": name, "isthing": int(thing)} for number, name, thing in CATEGORIES]
    instances = [{"id": index, "category_id": class_of[name], "name": name} for name, index in instance_of.items()]
    table = {"categories": categories, "instances": instances}
    (out / "gt/classes.json").write_text(json.dumps(table, indent=1) + "\n")


def _spline(knots: NDArray[np.float64], per_piece: int) -> NDArray[np.float64]:
    """Catmull-Rom curve through ``knots`` float64 [N, D]; returns float64 [(N - 1) * per_piece + 1, D]."""
    ends = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    t = (np.arange(per_piece) / per_piece)[:, None]
    pieces = []
    for a, b, c, d in zip(ends[:-3], ends[1:-2], ends[2:-1], ends[3:], strict=True):
        pieces.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    return np.concatenate([*pieces, knots[-1:]])


def walk(seed: int) -> list[NDArray[np.float64]]:
    """Poses along WALK, float64 [4, 4] camera-to-world, OpenCV axes, with the tremor of a hand drawn from ``seed``."""
    dense = _spline(np.array(WALK).reshape(len(WALK), 6), 100)
    eye, look = dense[:, :3], dense[:, 3:] - dense[:, :3]
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    turned = np.degrees(np.arccos(np.clip((look[1:] * look[:-1]).sum(1), -1, 1)))
    effort = np.linalg.norm(np.diff(eye, axis=0), axis=1) / STEP_METRES + turned / STEP_DEGREES
    travelled = np.concatenate([[0.0], np.cumsum(effort)])
    stops = np.interp(np.arange(0.0, travelled[-1]), travelled, np.arange(len(dense)))
    random = np.random.default_rng(seed)
    poses = []
    for stop in np.round(stops).astype(int):
        position = eye[stop] + random.normal(0, 0.015, 3)
        forward = look[stop] + random.normal(0, 0.012, 3)
        forward /= np.linalg.norm(forward)
        up = np.array([0.0, 0.0, 1.0]) + random.normal(0, 0.015, 3)  # a hand does not hold a phone quite level
        poses.append(pose_towards(position, forward, up))
    return poses


def pose_towards(eye: NDArray[np.float64], forward: NDArray[np.float64], up: ArrayLike) -> NDArray[np.float64]:
    """The camera-to-world pose, float64 [4, 4], at ``eye`` with a view along the unit vector ``forward``."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    return pose


if __name__ == "__main__":
    main()
