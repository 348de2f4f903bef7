"""From Gaussians to pictures: the kernels of the forward pass, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..machine import memory
from ..machine.compiled import Array
from ..machine.threads import parallel_for, worker_count
from .conventions import View
from .kernels import Kernels
from .portions import portion_count
from .projection import PROJECTION_BLOCK, camera_array, project
from .records import CHUNK, MEMBERS, RECORD, TILE
from .tile_lists import PairLists, Projected, list_tiles

WORDS_OF_LINE = memory.ALIGNMENT // 8


@dataclass(frozen=True, eq=False)
class ForwardState:
    """What the forward pass leaves for the backward one.

    ``camera`` float64 [CAMERA]; ``records`` float32 [N, RECORD]; ``rest`` and ``last`` float32 [H * W]: each pixel's
    final transmittance, and the place in its tile's list of the last Gaussian blended.
    """

    kernels: Kernels
    camera: Array
    records: Array
    lists: PairLists
    rest: Array
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
    """What the forward pass tells of each Gaussian: ``centres`` float32 [N, 2] on the image, and ``visible`` bool
    [N]."""

    centres: Array
    visible: Array


def as_array(tensor: Tensor) -> Array:
    """The same numbers in one piece, without their history."""
    return np.ascontiguousarray(tensor.numpy(force=True))


def blend(
    kernels: Kernels, gaussians: list[Array], labels: Array, view: View, on_image: OnImage
) -> tuple[Layers, ForwardState]:
    """``gaussians``: means [N, 3], scales [N, 3], quats [N, 4], opacities [N] and colours [N, 3]; labels [N, C], all
    float32. Fills ``on_image``."""
    # Kernels throw what Python needs out of the caches: what can be made ready before the first of them is.
    workers, camera = worker_count(), camera_array(view)
    count, channels = labels.shape
    layers = Layers.empty(view.height, view.width, channels)
    pixels = view.height * view.width
    rest, last, records = memory.several((pixels, np.float32), (pixels, np.float32), ((count, RECORD), np.float32))
    # apart from what is kept for the backward pass
    boxes, depths = memory.several(((count, 4), np.int32), (count, np.float32))
    results = records, boxes, depths, on_image.centres, on_image.visible
    portion_arguments = *gaussians, camera, view.width, view.height, *results
    projected = Projected(boxes, depths, np.empty((portion_count(count), 2), np.int64))
    parallel_for(
        workers,
        project,
        np.zeros(1, np.int64),
        projected.counts,
        memory.empty((workers, PROJECTION_BLOCK), np.float64),
        portion_arguments,
    )
    lists = list_tiles(workers, projected, view.width, view.height)
    blenders = lists.blenders(workers)
    parallel_for(
        blenders,
        kernels.blend,
        np.zeros(1, np.int64),
        lists.starts,
        lists.ids,
        records.reshape(-1),
        labels.reshape(-1),
        channels,
        view.width,
        view.height,
        *(layer.reshape(-1) for layer in layers.in_order()),
        rest,
        last,
        *scratch(blenders, kernels.blend_scratch(channels, lists.longest), lists.longest),
    )
    return layers, ForwardState(kernels, camera, records, lists, rest, last)


def scratch(workers: int, floats: int, longest: int) -> tuple[Array, ...]:
    """What each worker of a pass needs for itself: floats, lists of members, and a word a patch, row or chunk.

    Each has whole cache lines: workers that write to one and the same would wait for each other.
    """
    words = max(TILE + 1, -(-longest // CHUNK))
    return memory.several(
        ((workers, -(-floats // TILE) * TILE), np.float32),
        ((workers, MEMBERS), np.int32),
        ((workers, -(-words // WORDS_OF_LINE) * WORDS_OF_LINE), np.int64),
    )


def top_contributors(state: ForwardState, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """The largest weights of each pixel: Gaussians int32 and weights float32 [H, W, k]."""
    from .contributors import list_contributors  # compiled only where it is asked for

    indices, weights = torch.empty(shape, dtype=torch.int32), torch.empty(shape, dtype=torch.float32)
    lists = state.lists
    tops = indices.numpy(), weights.numpy()
    parallel_for(worker_count(), list_contributors, lists.starts, lists.ids, state.records, *tops)
    return indices, weights
