"""The entry point to rasterisation: checks the arguments, picks a back end, and returns a ``Rendering``."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .conventions import NEAR, Pinhole
from .rendering import BACKENDS, Backend, GaussianSet, Rendering, Wanted

log = logging.getLogger("plgs.raster")
_announced: set[str] = set()


def rasterize(
    means: Tensor,  # [N, 3], metres, world
    scales: Tensor,  # [N, 3], standard deviations in metres
    quats: Tensor,  # [N, 4], wxyz, normalised here
    opacities: Tensor,  # [N], 0 to 1; below 1/255, even below 0, none is drawn
    colours: Tensor,  # [N, 3]
    labels: Tensor | None,  # [N, C]
    camera_to_world: Tensor | NDArray[Any],  # [4, 4], OpenCV axes
    K: Tensor | NDArray[Any],  # [3, 3]; noqa: N803 (the intrinsics' usual name)
    width: int,
    height: int,
    *,
    near: float = NEAR,
    rows: tuple[int, int] | None = None,
    top_k: int = 0,
    want_surface: bool = False,
    want_means2d_grad: bool = False,
    is_orthographic: bool = False,
    backend: Backend | None = None,
) -> Rendering:
    """Draw N Gaussians; differentiable in the first six arguments, float32 tensors on one device. Returns a
    ``Rendering``.

    ``K`` has any fx, fy, cx, cy, but no skew; the centre of pixel (i, j) is (i + 0.5, j + 0.5). OpenCV axes: x right, y
    down, z forward. No gradient flows to the camera. ``rows`` draws only part of the picture, from the first row to
    before the second, with the same values as in the whole. ``is_orthographic``: rays are parallel, and ``K`` is in
    pixels per metre; drawn on the CPU, without gradients. ``top_k`` > 0: also return each pixel's largest contributors
    (not with ``gsplat``). ``want_surface``: also find the depth of the surface, always on the CPU. ``backend`` None:
    ``numba`` on the CPU, ``gsplat`` on CUDA.

    Conventions (gsplat's "classic"; ``cuda`` lists where gsplat itself differs): 0.3 px^2 is added to the diagonal of
    the 2D covariance; Gaussians with z <= ``near`` (metres) are not drawn; alpha = min(0.99, opacity * exp(-d^2/2)),
    skipped if below 1/255; a pixel ends before the Gaussian that would leave a transmittance <= 1e-4; the order is by
    planar depth rounded to float32, then by index.

    Raises ``ValueError`` if shapes, dtypes or devices do not fit, if the image is empty, if rows lie outside it, if K
    has skew, if the back end is unknown, or if an orthographic picture would need gradients."""
    gaussians = GaussianSet(means, scales, quats, opacities, colours, labels)
    _check(gaussians)
    pinhole = _pinhole(camera_to_world, K, width, height, near=near, rows=rows, is_orthographic=is_orthographic)
    if is_orthographic:
        if torch.is_grad_enabled() and any(each is not None and each.requires_grad for each in gaussians):
            raise ValueError("an orthographic picture has no gradients")
        gaussians = GaussianSet(*(each.cpu() for each in gaussians[:5]), None if labels is None else labels.cpu())
        means = gaussians.means
    if top_k < 0:
        raise ValueError(f"top_k is {top_k}; it must be 0 or more")
    drawn = _load(_pick(backend, means))(gaussians, pinhole, Wanted(top_k, want_surface, want_means2d_grad))
    if want_surface and drawn.surface is None:
        geometry = GaussianSet._make([*(each.detach().cpu().float() for each in gaussians[:5]), None])
        drawn = replace(drawn, surface=_load("numba")(geometry, pinhole, Wanted(0, True, False)).surface)
    return drawn


@cache
def _load(backend: Backend) -> Callable[[GaussianSet, Pinhole, Wanted], Rendering]:
    """Return the back end's function. It is imported only now, so that a program never waits for unused back ends."""
    if backend == "gsplat":
        from .cuda import rasterize_gsplat

        return rasterize_gsplat
    from .native import rasterize_native

    return rasterize_native


def _pick(backend: Backend | None, means: Tensor) -> Backend:
    """Return the name of the back end to use, by default according to the tensors' device. Logs the choice once."""
    by_device: Backend = "numba" if means.device.type == "cpu" else "gsplat"
    name: Backend = backend if backend is not None else by_device
    if name not in BACKENDS:
        raise ValueError(f"unknown back end {name!r}: choose one of {', '.join(BACKENDS)}")
    wanted = "cuda" if name == "gsplat" else "cpu"
    if means.device.type != wanted or means.dtype != torch.float32:
        raise ValueError(
            f"the back end {name} takes float32 tensors on the device {wanted}, these are {means.dtype} on "
            f"{means.device}; move them or choose another back end"
        )
    if name == "gsplat":
        from .cuda import what_is_missing

        missing = what_is_missing()
        if missing is not None:
            raise ValueError(f"the back end gsplat cannot be used: {missing}, or move the tensors to the CPU")
    if name not in _announced:
        _announced.add(name)
        log.info("rasterising with the back end %s on %s", name, means.device)
    return name


def _check(gaussians: GaussianSet) -> None:
    means, labels = gaussians.means, gaussians.labels
    count = means.shape[0] if means.ndim else 0
    channels = 0 if labels is None or not labels.ndim else labels.shape[-1]
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, channels))
    for name, tensor, shape in zip(GaussianSet._fields, gaussians, shapes, strict=True):
        if tensor is None:
            continue
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device}, but means is {means.dtype} on {means.device}; "
                "all must have the same dtype and device"
            )


def _pinhole(
    camera_to_world: Tensor | NDArray[Any],
    intrinsics: Tensor | NDArray[Any],
    width: int,
    height: int,
    *,
    near: float,
    rows: tuple[int, int] | None = None,
    is_orthographic: bool = False,
) -> Pinhole:
    if width < 1 or height < 1:
        raise ValueError(f"the image is {width}x{height}; both must be at least 1")
    first, end = rows or (0, height)
    if not 0 <= first < end <= height:
        raise ValueError(f"rows {first} to {end} lie outside an image of {height} rows")
    pose = _rows(camera_to_world, "camera_to_world", (4, 4))
    (fx, skew, cx), (_, fy, cy), _ = _rows(intrinsics, "K", (3, 3))
    if skew != 0.0:
        raise ValueError("K has skew; only fx, fy, cx, cy are supported")
    if not near > 0.0:  # also NaN
        raise ValueError(f"near is {near}; it must be positive")
    x_axis, y_axis, z_axis, centre = zip(*pose[:3], strict=True)
    return Pinhole(
        rotation=(*x_axis, *y_axis, *z_axis),
        centre=centre,
        focal=(fx, fy),
        principal=(cx, cy - first),  # from the first row that is drawn
        width=int(width),
        height=int(end - first),
        near=float(near),
        above=int(first),
        whole_height=int(height),
        is_orthographic=is_orthographic,
    )


def _rows(values: Tensor | NDArray[Any], name: str, shape: tuple[int, int]) -> list[list[float]]:
    """Return a matrix as lists of Python floats, row by row. ``name`` is for the error if its shape is wrong."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    values = np.asarray(values, dtype=np.float64)
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}, expected {shape}")
    rows: list[list[float]] = values.tolist()
    return rows
