"""From Gaussians to pictures: projection, binning, blending."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..machine import memory
from ..machine.compiled import Array
from ..machine.threads import parallel_for, worker_count
from .arrays import Blended, Gaussians, Intersections, Projected, Scratch, Size, Splats, flat
from .blending.batch import PATCHES
from .blending.contributors import list_contributors
from .blending.forward import blend_forward, scratch_size
from .conventions import Pinhole
from .isect_tiles import blending_workers, isect_tiles
from .projection import camera_array, project
from .records import MEMBERS, RECORD, TILE


@dataclass(frozen=True, eq=False)
class ForwardState:
    """What the forward pass keeps for the backward one.

    ``camera`` float64 [CAMERA]; ``records`` float32 [N, RECORD]; ``final`` and ``last`` float32 [H * W] as in
    ``Blended``.
    """

    camera: Array
    records: Array
    isects: Intersections
    final: Array
    last: Array


@dataclass(frozen=True, eq=False)
class Layers:
    """Image [H, W, 3], labels [H, W, C], alpha and depth [H, W], float32."""

    image: Array
    labels: Array
    alpha: Array
    depth: Array

    @classmethod
    def empty(cls, height: int, width: int, channels: int) -> Layers:
        shapes = ((height, width, 3), (height, width), (height, width))
        image, alpha, depth = memory.several(*((shape, np.float32) for shape in shapes))
        return cls(image, memory.empty((height, width, channels), np.float32), alpha, depth)

    def in_order(self) -> tuple[Array, ...]:
        return self.image, self.labels, self.alpha, self.depth


@dataclass(frozen=True, eq=False)
class OnImage:
    """Where the forward pass puts each Gaussian: ``means2d`` float32 [N, 2], and ``visible`` bool [N]."""

    means2d: Array
    visible: Array


def as_array(tensor: Tensor) -> Array:
    """The tensor's numbers as a contiguous array, detached from autograd."""
    return np.ascontiguousarray(tensor.numpy(force=True))


def rasterize_forward(
    gaussians: Gaussians, labels: Array, pinhole: Pinhole, on_image: OnImage
) -> tuple[Layers, ForwardState]:
    """Draw the Gaussians with ``labels`` float32 [N, C], and fill ``on_image``."""
    count, channels = labels.shape
    size, camera = Size(pinhole.width, pinhole.height, channels), camera_array(pinhole)
    layers = Layers.empty(size.height, size.width, channels)
    pixels = size.height * size.width
    final, last, records = memory.several((pixels, np.float32), (pixels, np.float32), ((count, RECORD), np.float32))
    out = Blended(*map(flat, layers.in_order()), final, last)

    boxes, depths = memory.several(((count, 4), np.int32), (count, np.float32))
    projected = Projected(records, boxes, depths, on_image.means2d, on_image.visible)
    parallel_for(worker_count(), project, gaussians, camera, size, projected, np.zeros(1, np.int64))
    isects, longest = isect_tiles(worker_count(), boxes, depths, size.width, size.height)
    workers = blending_workers(worker_count(), isects, longest)
    scratch = new_scratch(workers, scratch_size(channels, longest))
    parallel_for(workers, blend_forward, isects, Splats(flat(records), flat(labels)), out, size, scratch)
    return layers, ForwardState(camera, records, isects, final, last)


def new_scratch(workers: int, floats: int) -> Scratch:
    """Scratch for ``workers``, with ``floats`` for each.

    Each worker has whole cache lines, as workers that write to the same line would wait for each other.
    """
    return Scratch(
        np.zeros(1, np.int64),
        *memory.several(
            ((workers, -(-floats // TILE) * TILE), np.float32),
            ((workers, MEMBERS), np.int32),
            ((workers, PATCHES), np.int64),
        ),
    )


def top_contributors(state: ForwardState, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """The largest weights of each pixel, as Gaussians int32 and weights float32, [H, W, k] each."""
    indices, weights = torch.empty(shape, dtype=torch.int32), torch.empty(shape, dtype=torch.float32)
    tops = indices.numpy(), weights.numpy()
    parallel_for(worker_count(), list_contributors, state.isects, flat(state.records), *tops)
    return indices, weights
