"""How sharp a lift's surface is, drawn from the held-out frames with its texture and with its vertices' colours.

The surface is made of training frames. Three sets of pixels are compared: all pixels of the surface; those where it
lies where the frame measured it, as textures can't mend a wrong shape; and of these the near ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from time import process_time

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.export.fusion import Surface
from engine.export.mesh import views_of
from engine.export.source import FinishedLift
from engine.export.texture import Texture, textured
from engine.export.view_surface import MOST_VIEWS, WIDEST, surface_to_view
from engine.job import LiftFolder
from engine.metrics.images import psnr
from engine.posed.ply import labels_of_triangles
from engine.scene import Camera, photo_detail

NEAR = 1.5
"""Metres within which a surface is near."""
RIGHT, RIGHT_SHARE = 0.05, 0.02
"""Metres, and the share of the distance, within which a surface lies where it was measured."""


def sharpness_table(lifts: Sequence[Path], pictures: Path | None) -> Iterator[str]:
    """Lines of a table. With ``pictures``, a folder, each held-out photo is written there beside the two drawings.
    Raises PlgsError, OSError."""
    yield "| lift | pixels | vertex colours, dB | pictures, dB | detail of the photo | seconds |"
    yield "|---|---|---|---|---|---|"
    for path in lifts:
        folder = LiftFolder.open(path)
        frames = FinishedLift(folder, ["all"]).scene
        views = views_of(FinishedLift(folder, [each.name for each in frames.train_frames]), WIDEST, MOST_VIEWS)
        surface, label = surface_to_view(views)
        began = process_time()
        texture = textured(surface, label, views)
        seconds = process_time() - began
        scores: dict[str, list[tuple[float, float]]] = {"all": [], "where measured": [], f"within {NEAR} m": []}
        details = []
        for frame in frames.test_frames:
            photo, measured = frame.read_colour(None), frame.depth(frame.size)
            drawn, distance = draw(surface, label, texture, frame.camera)
            off = np.abs(distance - measured) - np.maximum(RIGHT, RIGHT_SHARE * measured)
            there, right = np.isfinite(distance), (measured > 0) & (off < 0)
            for name, which in zip(scores, (there, right, right & (measured < NEAR)), strict=True):
                if which.any():
                    scores[name].append((psnr(drawn[0], photo, which), psnr(drawn[1], photo, which)))
            details.append([photo_detail(each) / photo_detail(photo) for each in drawn])
            if pictures is not None:
                pictures.mkdir(parents=True, exist_ok=True)
                beside = np.concatenate([photo, *drawn], axis=1)[..., ::-1]
                cv2.imwrite(str(pictures / f"{path.name}_{frame.name}.png"), beside)
        for name, pairs in scores.items():
            if pairs:
                (before, after), (plain, sharp) = np.mean(pairs, axis=0), np.mean(details, axis=0)
                shares = f"{plain:.2f}, {sharp:.2f}"
                yield f"| {path.name} | {name} | {before:.2f} | {after:.2f} | {shares} | {seconds:.0f} |"


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
