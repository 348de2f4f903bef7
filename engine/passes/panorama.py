"""Make an equirectangular view from perspective views of the faces of a cube around the camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera
from .baked_view import SAME_SURFACE, BakedView
from .layers import PanopticLayers

_FINER = math.pi / 2
"""Pixels of a face, at its middle, where they see the widest angle, per pixel of the panorama; beside its middle more.
The full panorama's faces are half as wide as itself."""
_MARGIN = 2
"""Pixels around what the panorama takes of a face."""


def _turned(*axes: int) -> NDArray[np.float64]:
    """Return a rotation, float64 [4, 4], whose columns are these axes of the camera: 1, 2, 3: x, y, z; -1: -x, etc."""
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.sign(axis) * np.eye(3)[abs(axis) - 1] for axis in axes], axis=1)
    return turn


_FACES = (
    _turned(1, 2, 3), _turned(-3, 2, 1), _turned(-1, 2, -3), _turned(3, 2, -1), _turned(1, 3, -2), _turned(1, -3, 2),
)  # fmt: skip
"""Ahead, right, behind, left, above and below: right, down and forward of each face."""


def panorama(camera: Camera, draw: Callable[[Camera], BakedView]) -> BakedView:
    """The equirectangular ``camera``'s view, made from what ``draw`` returns for perspective cameras at its place.

    Labels, their shares, mattes and normals are those of the nearest pixel, as ids cannot be averaged. Colour and
    inverse depth are interpolated between four pixels; depth (distance from the camera) only if they show one
    surface."""
    x, y = (
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    level = np.cos(y)[:, None]
    rays = np.stack(
        [level * np.sin(x), np.broadcast_to(np.sin(y)[:, None], (camera.height, camera.width)), level * np.cos(x)]
    )
    ahead = np.stack([np.tensordot(face[:3, 2], rays, 1) for face in _FACES])
    face_of, made = ahead.argmax(axis=0), dict[str, Any]()
    view = None
    for number, face in enumerate(_FACES):
        inside = face_of == number
        if not inside.any():
            continue
        right, down, forward = face[:3, :3].T @ rays[:, inside]
        seen, at = _window(camera, face, right / forward, down / forward)
        view = draw(seen)
        taken = _taken(view, at, np.sqrt(1.0 + ((at - [seen.cx, seen.cy]) ** 2 / [seen.fx**2, seen.fy**2]).sum(axis=1)))
        for name, values in taken.items():
            whole = made.setdefault(name, np.zeros((*values.shape[:-1], *inside.shape), values.dtype))
            whole[..., inside] = values
    assert view is not None  # as a picture has pixels
    layers = {name: made[name] for name in PanopticLayers._fields}
    layers["combined"] = np.moveaxis(layers["combined"], 0, -1)
    mattes = tuple(replace(matte, ranks=made[matte.layer.name]) for matte in view.mattes)
    return BakedView(camera, PanopticLayers(**layers), mattes, guessed=made.get("guessed"), normal=made["normal"])


def _window(
    camera: Camera, face: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[Camera, NDArray[np.float64]]:
    """Return the camera of the part of a face with these slopes x / z and y / z, and their pixels, float64 [N, 2]."""
    focal = _FINER * max(camera.fx, camera.fy)
    corner = np.floor([focal * x.min(), focal * y.min()]) - _MARGIN
    width, height = (np.ceil([focal * x.max(), focal * y.max()]) + _MARGIN - corner).astype(int)
    pose = camera.camera_to_world @ face
    seen = Camera(int(width), int(height), focal, focal, -float(corner[0]), -float(corner[1]), pose)
    return seen, np.stack([focal * x, focal * y], axis=-1) - corner


def _taken(view: BakedView, at: NDArray[np.float64], slant: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Return the layers' values [..., N] at pixels ``at`` [N, 2]. ``slant`` [N] is distance / planar depth."""
    width = view.camera.width
    column, row = np.floor(at).astype(np.int64).T
    nearest = row * width + column
    (left, top), share = np.floor(at - 0.5).astype(np.int64).T, (at - 0.5) % 1.0
    across, down = share.T
    corners = [top * width + left + step for step in (0, 1, width, width + 1)]
    weights = [(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down]

    def of_nearest(values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(*values.shape[:-2], -1)[..., nearest]

    def blended(values: NDArray[Any]) -> NDArray[np.float64]:
        flat = values.reshape(*values.shape[:-2], -1)
        return sum(flat[..., corner] * weight for corner, weight in zip(corners, weights, strict=True))

    depth = view.layers.depth
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0).reshape(-1)
    own = inverse[nearest]
    is_one = np.all([np.abs(inverse[corner] - own) <= SAME_SURFACE * own for corner in corners], axis=0)
    inverse_depth = np.where(is_one, blended(inverse.reshape(depth.shape)), own)
    distance = np.divide(slant, inverse_depth, out=np.zeros_like(slant), where=own > 0)
    taken = {name: of_nearest(getattr(view.layers, name)) for name in ("semantic", "instance", "confidence", "entropy")}
    taken["depth"] = distance.astype(np.float32)
    taken["combined"] = blended(np.moveaxis(view.layers.combined, -1, 0)).astype(np.float32)
    taken["normal"] = of_nearest(view.surface.normal)
    taken |= {matte.layer.name: of_nearest(matte.ranks) for matte in view.mattes}
    return taken if view.guessed is None else taken | {"guessed": of_nearest(view.guessed)}
