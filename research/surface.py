"""How sharp a lift's surface is, drawn from the held-out frames with its texture and with its vertices' colours, beside
the coloured cloud that Blender's import shows.

Surface and cloud are made of training frames. Three sets of pixels are compared: all pixels that both show; those where
the surface lies where the frame measured it, as textures cannot mend a wrong shape; and of these the near ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from time import process_time

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from engine.export.fusion import Surface
from engine.export.mesh import views_of
from engine.export.source import FinishedLift
from engine.export.texture import Texture, textured
from engine.export.view_surface import MOST_VIEWS, WIDEST, surface_to_view
from engine.frames import CloudBuilder, ColouredCloud, add_to_cloud, cloud_strides
from engine.job import LiftFolder
from engine.metrics.images import psnr
from engine.posed.ply import labels_of_triangles
from engine.scene import Camera, Frame, photo_detail

NEAR = 1.5
"""Metres within which a surface is near."""
RIGHT, RIGHT_SHARE = 0.05, 0.02
"""Metres, and the share of the distance, within which a surface lies where it was measured."""
TOUCHING, MOST_PIXELS = 0.75, 12
"""Half the side of a point's square, in distances to its fourth neighbour, and the largest half side that is drawn, in
pixels."""


def sharpness_table(lifts: Sequence[Path], pictures: Path | None) -> Iterator[str]:
    """Lines of a table. With ``pictures``, a folder, each held-out photo is written there beside the two drawings.
    Raises PlgsError, OSError."""
    yield "| lift | pixels | import's cloud, dB | vertex colours, dB | pictures, dB | detail of the photo | seconds |"
    yield "|---|---|---|---|---|---|---|"
    for path in lifts:
        folder = LiftFolder.open(path)
        frames = FinishedLift(folder, ["all"]).scene
        cloud = coloured_cloud(frames.train_frames)
        views = views_of(FinishedLift(folder, [each.name for each in frames.train_frames]), WIDEST, MOST_VIEWS)
        surface, label = surface_to_view(views)
        began = process_time()
        texture = textured(surface, label, views)
        seconds = process_time() - began
        scores: dict[str, list[list[float]]] = {"all": [], "where measured": [], f"within {NEAR} m": []}
        details = []
        for frame in frames.test_frames:
            photo, measured = frame.read_colour(None), frame.depth(frame.size)
            drawn, distance = draw(surface, label, texture, frame.camera)
            squares, covered = draw_cloud(cloud, frame.camera)
            drawn = [squares, *drawn]
            off = np.abs(distance - measured) - np.maximum(RIGHT, RIGHT_SHARE * measured)
            there = np.isfinite(distance) & covered
            right = there & (measured > 0) & (off < 0)
            for name, which in zip(scores, (there, right, right & (measured < NEAR)), strict=True):
                if which.any():
                    scores[name].append([psnr(each, photo, which) for each in drawn])
            details.append([photo_detail(each) / photo_detail(photo) for each in drawn])
            if pictures is not None:
                pictures.mkdir(parents=True, exist_ok=True)
                beside = np.concatenate([photo, *drawn], axis=1)[..., ::-1]
                cv2.imwrite(str(pictures / f"{path.name}_{frame.name}.png"), beside)
        for name, pairs in scores.items():
            if pairs:
                decibels = " | ".join(f"{each:.2f}" for each in np.mean(pairs, axis=0))
                shares = ", ".join(f"{each:.2f}" for each in np.mean(details, axis=0))
                yield f"| {path.name} | {name} | {decibels} | {shares} | {seconds:.0f} |"


def coloured_cloud(frames: Sequence[Frame]) -> ColouredCloud:
    """The cloud that an import would make of these frames."""
    builder, strides = CloudBuilder(), cloud_strides(frames)
    for frame in frames:
        if frame.name in strides:
            add_to_cloud(builder, frame, strides[frame.name])
    return builder.cloud()


def draw_cloud(cloud: ColouredCloud, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """What a camera sees of the cloud as squares that face it and touch their neighbours, as in Blender: uint8
    [H, W, 3], and the pixels that they cover, bool [H, W]."""
    rows, pixel, distance = camera.seen(cloud.xyz)
    apart = cKDTree(cloud.xyz).query(cloud.xyz[rows], k=[5])[0][:, 0]
    reach = TOUCHING * apart * camera.fx / distance
    key = (distance * 1e5).astype(np.int64) << 32 | rows  # the nearest point has the smallest
    nearest = np.full(camera.width * camera.height, np.iinfo(np.int64).max)
    x, y = np.floor(pixel).astype(np.int64).T
    most = min(int(np.ceil(reach.max())), MOST_PIXELS)
    for down, right in product(range(-most, most + 1), repeat=2):
        column, row = x + right, y + down
        off = np.abs(np.stack([column, row], axis=1) + 0.5 - pixel).max(axis=1)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        drawn = inside & ((off <= reach) | ((down == 0) & (right == 0)))
        np.minimum.at(nearest, row[drawn] * camera.width + column[drawn], key[drawn])
    covered = nearest < np.iinfo(np.int64).max
    picture = np.where(covered[:, None], cloud.rgb[np.where(covered, nearest & 0xFFFFFFFF, 0)], 0).astype(np.uint8)
    return picture.reshape(camera.height, camera.width, 3), covered.reshape(camera.height, camera.width)


def draw(
    surface: Surface, label: NDArray[np.int64], texture: Texture, camera: Camera
) -> tuple[list[NDArray[np.uint8]], NDArray[np.float32]]:
    """What a camera sees of the surface by the vertices' colours and by the pictures, uint8 [H, W, 3] each, and its
    planar distance, float32 [H, W] m, infinite where there is none."""
    from open3d.core import Tensor
    from open3d.t.geometry import RaycastingScene

    scene = RaycastingScene()
    scene.add_triangles(Tensor.from_numpy(surface.xyz), Tensor.from_numpy(surface.triangles.astype(np.uint32)))
    ahead = camera.unproject(np.ones((camera.height, camera.width), np.float32)) - camera.centre
    rays = np.concatenate([np.broadcast_to(camera.centre, ahead.shape), ahead], axis=-1).astype(np.float32)
    hits = {name: values.numpy() for name, values in scene.cast_rays(Tensor.from_numpy(rays)).items()}
    is_hit = np.isfinite(hits["t_hit"])
    triangle, second = hits["primitive_ids"][is_hit].astype(np.int64), hits["primitive_uvs"][is_hit]
    weight = np.concatenate([1 - second.sum(axis=1, keepdims=True), second], axis=1)[..., None]
    plain = (surface.rgb[surface.triangles[triangle]] * weight).sum(axis=1)
    uv, sharp = (texture.uv[triangle] * weight).sum(axis=1), np.empty((len(triangle), 3))
    of_pixel = labels_of_triangles(surface.triangles, label)[triangle]
    for value in np.unique(of_pixel).tolist():
        picture, rows = texture.pictures[value], np.flatnonzero(of_pixel == value)
        for part in np.array_split(rows, len(rows) // 30_000 + 1):
            x, y = (uv[part] * picture.shape[1::-1] - 0.5).astype(np.float32).T
            sharp[part] = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    drawn = []
    for colours in (plain, sharp):
        drawn.append(np.zeros((*is_hit.shape, 3), np.uint8))
        drawn[-1][is_hit] = np.rint(colours.clip(0, 255))
    return drawn, hits["t_hit"]
