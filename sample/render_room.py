"""Render the sample room: ``python sample/render_room.py HOUSE.glb OUT [--samples N] [--every N]``.

HOUSE.glb is the AWS RoboMaker "small house" as one glTF file: one node for each object, with a property "category".
It writes posed RGB-D frames with ground truth: ``color/ depth/ pose/ intrinsic/ splits.json gt/``. Cycles path-traces
colour. Open3D casts depth and ids against the same triangles, so they are exact. The result is part of the repository:
nobody needs to run this program to use the sample. It needs bpy, open3d and cv2.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import bpy
import cv2
import numpy as np
import open3d as o3d
from mathutils import Matrix
from numpy.typing import NDArray
from room_plan import CATEGORIES, CLASS_OF_MODEL, MOVES, STANDS_ON, walk
from scene_files import write_image, write_intrinsics, write_split

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
    write_intrinsics(options.out, FOCAL, (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5))
    write_split(options.out, [f"{index:04d}" for index in range(len(poses))], range(0, len(poses), HELD_OUT_EVERY))
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
    """Soft light from the ceiling and a little from everywhere, in place of the model's bulbs."""
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


if __name__ == "__main__":
    main()
