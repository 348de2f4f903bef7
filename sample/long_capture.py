"""Make a long capture from the sample: ``python sample/long_capture.py OUT --frames N [--seed N]``.

The 72 frames of the bundled room are fused into a mesh (a truncated signed distance volume). Each corner gets the class
and the object that the ground truth shows there. Then a camera follows the sample's path again, lap after lap, each lap
slightly to the side of the last, and photographs the mesh N times. So a long capture needs nothing but this repository.
It is no better than its source: what no frame of the sample sees is a hole, and colour is that of the fused corners. It
measures time and memory. Its quality can only be compared with itself.

Pictures are cast at 324x242 and enlarged: colour and masks to 1296x968, depth to 648x484, as a phone's are. The masks
are those of ``network_masks``. Ground truth stays in ``gt/`` at 324x242. ``splits.json`` holds HELD_OUT frames out.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from mask_noise import MaskNoise
from network_masks import mask_of_frame
from numpy.typing import NDArray
from scene_files import (
    FOLDERS,
    PlgsError,
    mask_pixels,
    pose_towards,
    run,
    write_image,
    write_intrinsics,
    write_mask_table,
    write_split,
)

ROOM = Path(__file__).resolve().parent / "room"
WIDTH, HEIGHT = 324, 242
ENLARGED, DEPTH_ENLARGED = 4, 2
VOXEL = 0.03
"""Metres, the edge of a voxel of the fused volume."""
REACH = 9.0
"""Metres. Depth beyond is left out."""
LAP = 300
"""Frames per lap."""
ASIDE = 0.15
"""Metres between laps, root mean square."""
HELD_OUT = 8
"""Frames held out."""
SAME_SURFACE = 0.06
"""Metres between a corner and a frame's depth within which the frame shows the corner."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LabelledMesh:
    """``caster`` casts rays at the ``triangles`` uint32 [T, 3]. Each corner has a ``colour`` float32 [V, 3], 0..1,
    and a ``label`` int64 [V], class * 65536 + object.
    """

    caster: o3d.t.geometry.RaycastingScene
    triangles: NDArray[np.uint32]
    colour: NDArray[np.float32]
    label: NDArray[np.int64]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="scene folder to make; an existing one is refused")
    parser.add_argument("--frames", type=int, required=True, help="number of frames")
    parser.add_argument("--seed", type=int, default=0, help="seed of the laps' offsets and of the masks (default 0)")
    options = parser.parse_args()
    return run(lambda: write_long_capture(options.out, options.frames, options.seed))


def write_long_capture(out: Path, frames: int, seed: int) -> str:
    """Write the folder ``out`` as a whole, and return a line about it. Raises PlgsError, OSError."""
    if out.exists():
        raise PlgsError("this exists already", out, "Name a folder that does not exist yet.")
    poses, intrinsic = room_cameras()
    mesh = fuse(poses, intrinsic)
    focal = intrinsic[0, 0] * WIDTH / 320
    building = out.with_name(f"{out.name}.part")
    shutil.rmtree(building, ignore_errors=True)
    for name in FOLDERS:
        (building / name).mkdir(parents=True)
    shutil.copyfile(ROOM / "gt/classes.json", building / "gt/classes.json")
    names = [f"{number:05d}" for number in range(frames)]
    write_split(building, names, held_out(frames))
    categories = json.loads((ROOM / "gt/classes.json").read_text())["categories"]
    masks = {}
    # network_masks reads depth and intrinsics at the size of the ground truth.
    _write_lens(building, focal, 1)
    for name, pose in zip(names, laps(poses, frames, seed), strict=True):
        photograph(mesh, pose, focal, building, name)
        ids, masks[name] = mask_of_frame(building, name, categories, seed, MaskNoise())
        write_enlarged(building, name, ids)
    _write_lens(building, focal, ENLARGED)
    write_mask_table(building / "panoptic.json", masks, categories)
    building.rename(out)
    return f"{frames} frames in {out}"


def room_cameras() -> tuple[list[Floats], Floats]:
    """The sample's poses, camera-to-world float64 [4, 4], and its intrinsics, for pixel centres at whole numbers."""
    poses = [np.loadtxt(path) for path in sorted((ROOM / "pose").glob("*.txt"))]
    return poses, np.loadtxt(ROOM / "intrinsic/intrinsic_color.txt")[:3, :3]


def fuse(poses: list[Floats], intrinsic: Floats) -> LabelledMesh:
    """All frames of the sample as one mesh."""
    tensor, image = o3d.core.Tensor, o3d.t.geometry.Image
    names, kinds, sizes = ("tsdf", "weight", "color"), (o3d.core.float32,) * 3, ((1), (1), (3))
    volume = o3d.t.geometry.VoxelBlockGrid(names, kinds, sizes, VOXEL, 16, 20_000, o3d.core.Device("CPU:0"))
    pinhole = tensor(intrinsic)
    for number, pose in enumerate(poses):
        depth = image(tensor(_png(ROOM / f"depth/{number:04d}.png").astype(np.float32)))
        picture = cv2.imread(str(ROOM / f"color/{number:04d}.jpg"))[..., ::-1]
        colour = image(tensor(np.ascontiguousarray(picture).astype(np.float32)))
        to_camera = tensor(np.linalg.inv(pose))
        blocks = volume.compute_unique_block_coordinates(depth, pinhole, to_camera, 1000.0, REACH)
        volume.integrate(blocks, depth, colour, pinhole, to_camera, 1000.0, REACH)
    mesh = volume.extract_triangle_mesh(weight_threshold=1.0)
    corners = mesh.vertex.positions.numpy().astype(np.float64)
    triangles = mesh.triangle.indices.numpy().astype(np.uint32)
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(tensor(corners.astype(np.float32)), tensor(triangles))
    colours = mesh.vertex.colors.numpy() / np.float32(255.0)
    return LabelledMesh(caster, triangles, colours, corner_labels(corners, poses, intrinsic))


def corner_labels(corners: Floats, poses: list[Floats], intrinsic: Floats) -> NDArray[np.int64]:
    """The label that the nearest of the frames that see a corner shows there, int64 [V]; 0 where none sees it."""
    label = np.zeros(len(corners), np.int64)
    nearest = np.full(len(corners), np.inf)
    for number, pose in enumerate(poses):
        depth = _png(ROOM / f"depth/{number:04d}.png") / 1000.0
        semantic, instance = (_png(ROOM / f"gt/{kind}/{number:04d}.png") for kind in ("semantic", "instance"))
        seen = (corners - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(seen[:, 2], 1e-6)
        column = np.rint(seen[:, 0] / z * intrinsic[0, 0] + intrinsic[0, 2]).astype(np.int64)
        row = np.rint(seen[:, 1] / z * intrinsic[1, 1] + intrinsic[1, 2]).astype(np.int64)
        inside = (seen[:, 2] > 0.1) & (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
        place = np.flatnonzero(inside)
        row, column, z = row[place], column[place], z[place]
        shows = (np.abs(depth[row, column] - z) < SAME_SURFACE) & (z < nearest[place])
        place, row, column = place[shows], row[shows], column[shows]
        nearest[place] = z[shows]
        label[place] = semantic[row, column].astype(np.int64) * 65536 + instance[row, column]
    return label


def laps(poses: list[Floats], frames: int, seed: int) -> list[Floats]:
    """``frames`` poses along the sample's path and back, lap after lap, each lap to the side of the others."""
    random = np.random.default_rng(seed)
    centres = np.array([pose[:3, 3] for pose in poses])
    looks = np.array([pose[:3, 2] for pose in poses])
    found = []
    for start in range(0, frames, LAP):
        count = min(LAP, frames - start) if frames > LAP else frames
        along = np.linspace(0, len(poses) - 1, count)
        along = along if start // LAP % 2 == 0 else along[::-1]
        aside = random.normal(0.0, ASIDE, 3) * [1.0, 1.0, 0.5]
        for stop in along:
            eye = np.array([np.interp(stop, range(len(poses)), centres[:, axis]) for axis in range(3)])
            look = np.array([np.interp(stop, range(len(poses)), looks[:, axis]) for axis in range(3)])
            eye, look = eye + aside + random.normal(0.0, 0.01, 3), look + random.normal(0.0, 0.01, 3)
            found.append(pose_towards(eye, look / np.linalg.norm(look), (0.0, 0.0, 1.0)))
    return found[:frames]


def photograph(mesh: LabelledMesh, pose: Floats, focal: float, out: Path, name: str) -> None:
    """Write colour, depth and ground truth of one frame. Depth is not enlarged yet."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], -1) @ pose[:3, :3].T  # length 1 along the optical axis
    origin = np.broadcast_to(pose[:3, 3], rays.shape)
    answer = mesh.caster.cast_rays(o3d.core.Tensor(np.concatenate([origin, rays], -1).astype(np.float32)))
    distance, across = answer["t_hit"].numpy(), answer["primitive_uvs"].numpy()
    hit = np.isfinite(distance)
    corners = mesh.triangles[np.where(hit, answer["primitive_ids"].numpy(), 0)]
    weight = np.stack([1.0 - across.sum(-1), across[..., 0], across[..., 1]], -1)
    colour = (mesh.colour[corners] * weight[..., None]).sum(-2) * hit[..., None]
    label = np.where(hit, mesh.label[np.take_along_axis(corners, weight.argmax(-1)[..., None], -1)[..., 0]], 0)
    large = cv2.resize(colour, (ENLARGED * WIDTH, ENLARGED * HEIGHT), interpolation=cv2.INTER_CUBIC)
    pixels = (large.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    write_image(out / f"color/{name}.jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    millimetres = np.where(hit, np.clip(np.round(distance * 1000), 0, 65535), 0).astype(np.uint16)
    write_image(out / f"depth/{name}.png", millimetres)
    write_image(out / f"gt/semantic/{name}.png", (label >> 16).astype(np.uint16))
    write_image(out / f"gt/instance/{name}.png", (label & 65535).astype(np.uint16))
    np.savetxt(out / f"pose/{name}.txt", pose, fmt="%.9f")


def write_enlarged(out: Path, name: str, ids: NDArray[np.int32]) -> None:
    """Write the mask int32 [H, W], and the depth that is there, at the sizes of the capture."""
    large = mask_pixels(ids).repeat(ENLARGED, 0).repeat(ENLARGED, 1)
    write_image(out / f"panoptic/{name}.png", large, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    depth = _png(out / f"depth/{name}.png").repeat(DEPTH_ENLARGED, 0).repeat(DEPTH_ENLARGED, 1)
    write_image(out / f"depth/{name}.png", depth)


def held_out(frames: int) -> list[int]:
    """The numbers of HELD_OUT frames, evenly spread."""
    return [int(place) for place in np.linspace(0, frames - 1, min(HELD_OUT, frames) + 2).astype(int)[1:-1]]


def _write_lens(out: Path, focal: float, scale: int) -> None:
    write_intrinsics(out, focal * scale, (WIDTH * scale / 2 - 0.5, HEIGHT * scale / 2 - 0.5))


def _png(path: Path) -> NDArray[np.uint16]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint16)


if __name__ == "__main__":
    sys.exit(main())
