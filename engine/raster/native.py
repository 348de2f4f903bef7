"""The back end ``numba``: the kernels strung together as a ``torch.autograd.Function``."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import memory, tiles
from .compile_backward import compile_backward
from .conventions import NEAR, View
from .crew import share, worker_count
from .gather import gather
from .kernels import Kernels, choose_kernels
from .projection import project
from .records import CHUNK, GRADIENT_WIDTH, RECORD, TILE
from .rendering import Rendering
from .warm_up import WarmUp

log = logging.getLogger("plgs.raster")

LABELS = 5
"""Their place among the arguments."""


def rasterize_native(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    colours: Tensor,
    labels: Tensor | None,
    view: View,
    top_k: int,
    want_means2d_grad: bool,
) -> Rendering:
    """As ``rasterize``, for float32 tensors on the CPU. As many threads as ``torch.get_num_threads()``."""
    centres = memory.empty_tensor((means.shape[0], 2)).requires_grad_(want_means2d_grad)
    visible = torch.empty(means.shape[0], dtype=torch.bool)
    inputs = (means, scales, quats, opacities, colours, labels, centres)
    differentiable = any(tensor is not None and tensor.requires_grad for tensor in inputs)
    _warm_up(choose_kernels()).forward(torch.is_grad_enabled() and differentiable)
    layers = _Blend.apply(*inputs, view, visible, top_k)
    image, labels_out, alpha, depth, top_indices, top_weights = layers
    return Rendering(
        image=image,
        labels=labels_out if labels is not None else None,
        alpha=alpha,
        depth=depth,
        visible=visible,
        means2d=centres,
        top_indices=top_indices if top_k else None,
        top_weights=top_weights if top_k else None,
    )


@cache
def _warm_up(kernels: Kernels) -> WarmUp:
    """The one warm-up of these kernels in this process."""
    log.info("blending with the %s kernels, %d threads", kernels.name, worker_count())
    apart = compile_backward.__module__
    return WarmUp(kernels.name, _compile_forward, partial(compile_backward, kernels), apart)


def _compile_forward() -> None:
    """Call every kernel of the forward pass, with one Gaussian."""
    inputs = [torch.ones(shape) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1, 3), (1, 1), (1, 2))]
    view = View(np.eye(3), np.array([0.0, 0.0, -3.0]), (1.0, 1.0), (0.5, 0.5), 1, 1, NEAR)
    _Blend.apply(*inputs, view, torch.empty(1, dtype=torch.bool), 0)


def camera_array(view: View) -> NDArray[np.float64]:
    """The camera as the kernels take it, float64 [CAMERA]."""
    values = [
        *view.rotation.ravel(),
        *view.centre,
        *view.focal,
        *view.principal,
        view.near,
        *view.slope_limits(),
    ]
    return np.array(values, dtype=np.float64)


def _array(tensor: Tensor) -> NDArray[Any]:
    return tensor.detach().contiguous().numpy()


def _scratch(workers: int, floats: int, longest: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """What each worker of a pass needs for itself: floats, members of a chunk, and a word a patch, row or chunk."""
    return (
        memory.empty((workers, -(-floats // TILE) * TILE), np.float32),
        memory.empty((workers, (TILE + 1) * CHUNK), np.int32),
        memory.empty((workers, max(TILE + 1, -(-longest // CHUNK))), np.int64),
    )


@dataclass(frozen=True, eq=False)
class _Lists:
    """Which Gaussians each tile draws, and where their gradients go.

    ``slots`` int64 [N + 1] and ``starts`` int64 [tiles + 1]: each Gaussian's and each tile's first place among all T
    pairs of them; ``ids`` and ``tile_slots`` int32 [T], tile after tile: the Gaussian, and its place.
    """

    slots: NDArray[Any]
    starts: NDArray[Any]
    ids: NDArray[Any]
    tile_slots: NDArray[Any]

    @cached_property
    def longest(self) -> int:
        """Gaussians in the longest list."""
        return int(np.diff(self.starts).max())

    def blenders(self, workers: int) -> int:
        """A worker has room for the longest list: no more of them than there are such lists to do."""
        return min(workers, max(1, -(-len(self.ids) // max(1, self.longest))))


def _list_tiles(
    workers: int,
    records: NDArray[Any],
    boxes: NDArray[Any],
    counts: NDArray[Any],
    view: View,
    centres: NDArray[Any],
    visible: NDArray[Any],
) -> _Lists:
    """``counts`` int64 [workers, 2] are those of ``project``; fills ``centres`` and ``visible``."""
    shown, touched = (int(total) for total in counts.sum(0))
    before = np.cumsum(counts, 0) - counts
    keys, ids = memory.empty(shown, np.uint32), memory.empty(shown, np.int32)
    slots = memory.empty(len(records) + 1, np.int64)
    places, slot_starts = np.ascontiguousarray(before[:, 0]), np.ascontiguousarray(before[:, 1])
    share(
        workers,
        tiles.list_visible,
        boxes,
        records,
        records.view(np.uint32),
        places,
        slot_starts,
        keys,
        ids,
        slots,
        centres,
        visible,
    )
    sorters = workers if shown >= tiles.WORTH_SHARING else 1
    order = tiles.sort_by_depth(sorters, keys, ids)
    return _Lists(slots, *tiles.deal(sorters, order, boxes, slots, touched, view.width, view.height))


@dataclass(frozen=True, eq=False)
class _State:
    """What the forward pass leaves for the backward one."""

    kernels: Kernels
    camera: NDArray[Any]
    records: NDArray[Any]
    lists: _Lists
    rest: NDArray[Any]
    last: NDArray[Any]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        scales: Tensor,
        quats: Tensor,
        opacities: Tensor,
        colours: Tensor,
        labels: Tensor | None,
        centres: Tensor,
        view: View,
        visible: Tensor,
        top_k: int,
    ) -> tuple[Tensor, ...]:
        workers, kernels = worker_count(), choose_kernels()
        camera = camera_array(view)
        count, width, height = means.shape[0], view.width, view.height
        inputs = [_array(tensor) for tensor in (means, scales, quats, opacities, colours)]
        features = _array(labels) if labels is not None else np.empty((count, 0), np.float32)
        channels = features.shape[1]
        records, boxes = memory.empty((count, RECORD), np.float32), memory.empty((count, 4), np.int32)
        counts = np.zeros((workers, 2), np.int64)
        share(workers, project, *inputs, camera, width, height, records, boxes, counts)
        lists = _list_tiles(workers, records, boxes, counts, view, _array(centres), visible.numpy())
        blenders = lists.blenders(workers)
        image, labels_out = (
            memory.empty_tensor((height, width, 3)),
            memory.empty_tensor((height, width, channels)),
        )
        alpha, depth = memory.empty_tensor((height, width)), memory.empty_tensor((height, width))
        rest, last = memory.empty(height * width, np.float32), memory.empty(height * width, np.float32)
        share(
            blenders,
            kernels.blend,
            np.zeros(1, np.int64),
            lists.starts,
            lists.ids,
            records.reshape(-1),
            features.reshape(-1),
            channels,
            width,
            height,
            *(layer.numpy().reshape(-1) for layer in (image, labels_out, alpha, depth)),
            rest,
            last,
            *_scratch(blenders, kernels.blend_scratch(channels, lists.longest), lists.longest),
        )
        top_indices = torch.empty((height, width, top_k), dtype=torch.int32)
        top_weights = torch.empty((height, width, top_k), dtype=torch.float32)
        if top_k:
            from .contributors import list_contributors

            share(
                workers,
                list_contributors,
                lists.starts,
                lists.ids,
                records,
                top_indices.numpy(),
                top_weights.numpy(),
            )
        ctx.mark_non_differentiable(top_indices, top_weights)
        ctx.save_for_backward(means, scales, quats)
        ctx.state = _State(kernels, camera, records, lists, rest, last)
        ctx.has_labels = labels is not None
        return image, labels_out, alpha, depth, top_indices, top_weights

    @staticmethod
    def backward(
        ctx: Any, d_image: Tensor, d_labels: Tensor, d_alpha: Tensor, d_depth: Tensor, *_: Tensor
    ) -> tuple[Tensor | None, ...]:
        state = ctx.state
        _warm_up(state.kernels).backward()
        scene = tuple(_array(tensor) for tensor in ctx.saved_tensors)
        wants_labels = ctx.has_labels and ctx.needs_input_grad[LABELS]
        own_labels = _array(d_labels) if wants_labels else None
        gradients = _gradients(state, scene, _array(d_image), own_labels, _array(d_alpha), _array(d_depth))
        wanted = [
            gradient if need else None for gradient, need in zip(gradients, ctx.needs_input_grad, strict=False)
        ]
        return (*wanted, None, None, None)


def _gradients(
    state: _State,
    scene: tuple[NDArray[Any], ...],
    d_image: NDArray[Any],
    d_labels: NDArray[Any] | None,
    d_alpha: NDArray[Any],
    d_depth: NDArray[Any],
) -> list[Tensor | None]:
    """Of means, scales and quats (the ``scene``), opacities, colours, labels (None without ``d_labels``) and the
    centres on the image."""
    workers, lists = worker_count(), state.lists
    height, width = d_alpha.shape
    d_features = d_labels if d_labels is not None else np.empty((height, width, 0), np.float32)
    channels = d_features.shape[2]
    touched, slot_gradients, slot_labels = _unblend(workers, state, d_image, d_features, d_alpha, d_depth)
    count = len(state.records)
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, channels), (count, 2))
    gradients: list[Tensor | None] = [memory.empty_tensor(shape) for shape in shapes]
    arrays = [gradient.numpy() for gradient in gradients if gradient is not None]
    own_labels = arrays.pop(LABELS).reshape(-1)
    if d_labels is None:
        gradients[LABELS] = None
    else:
        gather_labels = state.kernels.gather_labels
        share(workers, gather_labels, lists.slots, touched, slot_labels, channels, own_labels)
    share(
        workers,
        gather,
        lists.slots,
        touched,
        slot_gradients,
        state.records,
        *scene,
        state.camera,
        memory.empty((workers, TILE), np.float64),
        *arrays,
    )
    return gradients


def _unblend(
    workers: int,
    state: _State,
    d_image: NDArray[Any],
    d_labels: NDArray[Any],
    d_alpha: NDArray[Any],
    d_depth: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """touched uint8 [T], gradients [T * GRADIENT_WIDTH] and label gradients [T * padded channels] of the
    slots."""
    kernels, lists = state.kernels, state.lists
    height, width, channels = d_labels.shape
    touches = lists.ids.shape[0]
    padded = -(-channels // TILE) * TILE
    touched = memory.empty(touches, np.uint8)
    slot_gradients = memory.empty(touches * GRADIENT_WIDTH, np.float32)
    slot_labels = memory.empty(touches * padded, np.float32)
    share(
        workers,
        kernels.unblend,
        np.zeros(1, np.int64),
        lists.starts,
        lists.ids,
        lists.tile_slots,
        state.records.reshape(-1),
        state.rest,
        state.last,
        d_image.reshape(-1),
        d_labels.reshape(-1),
        channels,
        d_alpha.reshape(-1),
        d_depth.reshape(-1),
        width,
        height,
        touched,
        slot_gradients,
        slot_labels,
        *_scratch(workers, kernels.unblend_scratch(channels), lists.longest),
    )
    return touched, slot_gradients, slot_labels
