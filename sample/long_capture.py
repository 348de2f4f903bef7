"""Make a long capture out of the sample: ``python sample/long_capture.py OUT --frames N [--seed N]``.

The bundled room is fused into a mesh (a truncated signed distance volume of its 72 frames), every corner of which is
given the class and the object that the ground truth shows there. Then a camera walks the sample's way again, lap after
lap, each lap a little aside of the last, and photographs the mesh N times. So a long capture needs nothing but what
the repository holds. It is no better than its source: what no frame of the sample sees is a hole, and colour is that
of the fused corners. It measures time and memory; quality only against itself.

Pictures are cast at 324x242 and enlarged: colour and masks to 1296x968, depth to 648x484, as a phone's are. The masks
are those of ``machine_masks``. Ground truth stays in ``gt/`` at 324x242. ``splits.json`` holds HELD_OUT frames out.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from machine_masks import mask_of_frame, readable
from mask_noise import MaskNoise
from numpy.typing import NDArray

ROOM = Path(__file__).resolve().parent / "room"
WIDTH, HEIGHT = 324, 242
ENLARGED, DEPTH_ENLARGED = 4, 2
VOXEL = 0.03
"""Metres, of the fused volume."""
REACH = 9.0
"""Metres: what is further away in the sample is left out."""
LAP = 300
"""Frames a lap."""
ASIDE = 0.15
"""Metres that laps lie aside of each other, root mean square."""
HELD_OUT = 8
SAME_SURFACE = 0.06
"""Metres between a corner and a frame's depth within which the frame shows the corner."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LabelledMesh:
    """``caster`` casts rays at the triangles uint32 [T, 3]; the corners' ``colour`` float32 [V, 3] in [0, 1], and
    ``label`` int64 [V], class * 65536 + object."""

    caster: o3d.t.geometry.RaycastingScene
    triangles: NDArray[np.uint32]
    colour: NDArray[np.float32]
    label: NDArray[np.int64]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="scene folder to make; an existing one is refused")
    parser.add_argument("--frames", type=int, required=True, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="seed of the laps' offsets and of the masks (default 0)")
    options = parser.parse_args()
    if options.out.exists():
        raise SystemExit(f"this exists already: {options.out}. Name a folder that is not there yet.")
    write_long_capture(options.out, options.frames, options.seed)


def write_long_capture(out: Path, frames: int, seed: int) -> None:
    """Write the folder ``out``, which appears when it is whole."""
    poses, intrinsic = room_cameras()
    mesh = fuse(poses, intrinsic)
    focal = intrinsic[0, 0] * WIDTH / 320
    building = out.with_name(f"{out.name}.part")
    shutil.rmtree(building, ignore_errors=True)
    for name in ("color", "depth", "pose", "intrinsic", "panoptic", "gt/semantic", "gt/instance"):
        (building / name).mkdir(parents=True)
    small, large = (_intrinsics(focal * scale, WIDTH * scale, HEIGHT * scale) for scale in (1, ENLARGED))
    shutil.copyfile(ROOM / "gt/classes.json", building / "gt/classes.json")
    (building / "splits.json").write_text(json.dumps(split(frames)))
    categories = json.loads((ROOM / "gt/classes.json").read_text())["categories"]
    images, annotations = [], []
    for number, pose in enumerate(laps(poses, frames, seed)):
        name = f"{number:05d}"
        photograph(mesh, pose, focal, building, name)
        # The masks' program takes depth and intrinsics of the size of the ground truth.
        np.savetxt(building / "intrinsic/intrinsic_color.txt", small, "%.9f")
        ids, segments = mask_of_frame(building, name, categories, seed, MaskNoise())
        write_enlarged(building, name, ids)
        images.append({"id": name, "file_name": f"{name}.jpg", "width": ids.shape[1], "height": ids.shape[0]})
        annotations.append({"image_id": name, "file_name": f"{name}.png", "segments_info": segments})
    table = {"images": images, "annotations": annotations, "categories": categories}
    (building / "panoptic.json").write_text(readable(table))
    np.savetxt(building / "intrinsic/intrinsic_color.txt", large, "%.9f")
    building.rename(out)


def room_cameras() -> tuple[list[Floats], Floats]:
    """The sample's poses, camera-to-world float64 [4, 4], and its intrinsics for pixel centres at integers."""
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
    """What the frame nearest to each corner, of those that see it, shows there; int64 [V], 0 where none does."""
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
    """``frames`` poses along the sample's way there and back, lap after lap, each aside of the others."""
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
            found.append(_pose(eye + aside + random.normal(0.0, 0.01, 3), look + random.normal(0.0, 0.01, 3)))
    return found[:frames]


def _pose(eye: Floats, look: Floats) -> Floats:
    """Camera-to-world of a camera held level."""
    forward = look / np.linalg.norm(look)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    return pose


def photograph(mesh: LabelledMesh, pose: Floats, focal: float, out: Path, name: str) -> None:
    """Colour, depth and ground truth of one frame; depth is small as yet."""
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
    cv2.imwrite(str(out / f"color/{name}.jpg"), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    millimetres = np.where(hit, np.clip(np.round(distance * 1000), 0, 65535), 0).astype(np.uint16)
    cv2.imwrite(str(out / f"depth/{name}.png"), millimetres)
    cv2.imwrite(str(out / f"gt/semantic/{name}.png"), (label >> 16).astype(np.uint16))
    cv2.imwrite(str(out / f"gt/instance/{name}.png"), (label & 65535).astype(np.uint16))
    np.savetxt(out / f"pose/{name}.txt", pose, fmt="%.9f")


def write_enlarged(out: Path, name: str, ids: NDArray[np.int32]) -> None:
    """The mask int32 [H, W], and the depth that is there, as large as the capture has them."""
    colour = np.stack([ids >> 16, (ids >> 8) & 255, ids & 255], -1).astype(np.uint8)  # OpenCV writes B, G, R
    large = colour.repeat(ENLARGED, 0).repeat(ENLARGED, 1)
    cv2.imwrite(str(out / f"panoptic/{name}.png"), large, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    depth = _png(out / f"depth/{name}.png").repeat(DEPTH_ENLARGED, 0).repeat(DEPTH_ENLARGED, 1)
    cv2.imwrite(str(out / f"depth/{name}.png"), depth)


def split(frames: int) -> dict[str, list[str]]:
    """HELD_OUT frames, evenly spread, are held out."""
    stems = [f"{number:05d}" for number in range(frames)]
    test = [stems[place] for place in np.linspace(0, frames - 1, min(HELD_OUT, frames) + 2).astype(int)[1:-1]]
    return {"train": [stem for stem in stems if stem not in set(test)], "test": test}


def _intrinsics(focal: float, width: int, height: int) -> Floats:
    """As ScanNet: 4x4, for pixel centres at integers, hence the half pixel."""
    matrix = np.diag([focal, focal, 1.0, 1.0])
    matrix[:2, 2] = width / 2 - 0.5, height / 2 - 0.5
    return matrix


def _png(path: Path) -> NDArray[np.uint16]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint16)


if __name__ == "__main__":
    main()
