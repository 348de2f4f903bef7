"""The back end ``numba``: both passes as a ``torch.autograd.Function``, compiled when first needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..machine import memory
from ..machine.compiled import Array
from ..machine.log_compilation import log_compilation
from ..machine.threads import parallel_for, worker_count
from . import arrays
from .blending.backward import backward_scratch_size, blend_backward
from .blending.batch import PATCHES, gather, list_channels
from .blending.contributors import find_surface, list_contributors, scratch_sizes
from .blending.forward import blend_forward, scratch_size
from .conventions import GRADIENT_WIDTH, MEMBERS, RECORD, TILE, Pinhole, padded_channels
from .isect_tiles import blending_workers, isect_tiles
from .projection import camera_array, project
from .rendering import GaussianSet, Rendering, Wanted

# From Gaussians to pictures: projection, binning, blending.


@dataclass(frozen=True, eq=False)
class ForwardState:
    """What the forward pass keeps for the backward pass. ``camera`` float64 [CAMERA]; ``records`` float32 [N, RECORD];
    ``isects``, the tiles' lists; ``final`` and ``last`` float32 [H * W], as in ``Blended``."""

    camera: Array
    records: Array
    isects: arrays.Intersections
    final: Array
    last: Array


class Layers(NamedTuple):
    """The layers of a rendering: image [H, W, 3], labels [H, W, C], alpha and depth [H, W]; float32."""

    image: Array
    labels: Array
    alpha: Array
    depth: Array

    @classmethod
    def empty(cls, height: int, width: int, channels: int) -> Layers:
        shapes = ((height, width, 3), (height, width, channels), (height, width), (height, width))
        return cls(*(memory.empty(shape, np.float32) for shape in shapes))


def as_array(tensor: Tensor) -> Array:
    """Return the tensor's values as a contiguous array, detached from autograd."""
    return np.ascontiguousarray(tensor.numpy(force=True))


def rasterize_forward(
    gaussians: arrays.Gaussians, labels: Array, pinhole: Pinhole, on_image: tuple[Array, Array]
) -> tuple[Layers, ForwardState]:
    """Draw the Gaussians with ``labels`` float32 [N, C]. Return the layers, and the state for the backward pass. Fills
    the two arrays ``on_image``: projected centres float32 [N, 2], pixels, and visibility bool [N]."""
    count, channels = labels.shape
    size, camera = arrays.Size(pinhole.width, pinhole.height, channels), camera_array(pinhole)
    layers = Layers.empty(size.height, size.width, channels)
    pixels = size.height * size.width
    final, last, records = memory.several((pixels, np.float32), (pixels, np.float32), ((count, RECORD), np.float32))
    out = arrays.Blended(*map(arrays.flat, layers), final, last)

    boxes, depths = memory.several(((count, 4), np.int32), (count, np.float32))
    projected = arrays.Projected(records, boxes, depths, *on_image)
    parallel_for(worker_count(), project, gaussians, camera, size, projected, np.zeros(1, np.int64))
    isects, longest = isect_tiles(worker_count(), boxes, depths, size.width, size.height)
    workers = blending_workers(worker_count(), isects, longest)
    scratch = new_scratch(workers, scratch_size(channels, longest))
    splats = arrays.Splats(arrays.flat(records), arrays.flat(labels))
    parallel_for(workers, blend_forward, isects, splats, out, size, scratch)
    return layers, ForwardState(camera, records, isects, final, last)


def new_scratch(workers: int, floats: int) -> arrays.Scratch:
    """Allocate ``floats`` of working memory for each worker, rounded up to whole cache lines: workers that write to the
    same line would wait for each other."""
    floats = -(-floats // TILE) * TILE
    wanted = ((workers, floats), np.float32), ((workers, MEMBERS), np.int32), ((workers, PATCHES), np.int64)
    return arrays.Scratch(np.zeros(1, np.int64), *memory.several(*wanted))


def _for_contributors(kernel: Any, state: ForwardState, *out: Any) -> None:
    """Run ``kernel`` of ``blending/contributors.py`` on a forward pass; it fills the arrays ``out``."""
    longest = int(np.diff(state.isects.isect_offsets).max(initial=0))
    workers = blending_workers(worker_count(), state.isects, longest)
    floats, integers = scratch_sizes(longest)
    scratches = memory.several(((workers, floats), np.float32), ((workers, integers), np.int32))
    parallel_for(workers, kernel, state.isects, arrays.flat(state.records), scratches, *out)


# From the gradients of pictures to those of Gaussians: backward blending, sums over tiles, backward projection.


def rasterize_backward(state: ForwardState, shapes: arrays.Shapes, d_layers: Layers) -> arrays.GaussianGradients:
    """Return the gradients of the Gaussians, given those of the layers, ``d_layers`` (whose labels have no channels if
    no label has a gradient). ``state`` and ``shapes`` are of the forward pass."""
    height, width, channels = d_layers.labels.shape
    size, workers = arrays.Size(width, height, channels), worker_count()
    tiles, count, n = len(state.isects.isect_offsets) - 1, len(state.isects.flatten_ids), len(state.records)
    counts, listed = np.zeros(tiles, np.int64), memory.empty(tiles * channels, np.int32)
    if channels:
        parallel_for(workers, list_channels, arrays.flat(d_layers.labels).view(np.int32), size, counts, listed)
    used = arrays.TileChannels(counts, listed, padded_channels(int(counts.max())))
    values, labels = (count * GRADIENT_WIDTH, np.float32), (count * used.padded, np.float32)
    isects = arrays.IsectGradients(used, *memory.several((count, np.int32), values, labels))
    sizes = ((n, 3), (n, 3), (n, 4), (n,), (n, 3), (n, channels), (n, 2))
    out = arrays.GaussianGradients(*(memory.empty(each, np.float32) for each in sizes))
    pixels = arrays.Blended(*map(arrays.flat, d_layers), state.final, state.last)
    scratch = new_scratch(workers, backward_scratch_size(used.padded))
    parallel_for(workers, blend_backward, state.isects, arrays.flat(state.records), pixels, size, isects, scratch)
    scene = (shapes, state.records, state.camera)
    flat_out = out._replace(labels=arrays.flat(out.labels))
    parallel_for(
        workers, gather, state.isects.gaussian_offsets, isects, channels, scene, flat_out, np.zeros(1, np.int64)
    )
    return out


LABELS = 5
"""Index of the labels among the arguments."""
COMPILATION = "10 s"
"""The time to compile a pass, for the log."""


def rasterize_native(gaussians: GaussianSet, pinhole: Pinhole, wanted: Wanted) -> Rendering:
    """Draw Gaussians as ``rasterize`` does: float32 tensors on the CPU, with ``torch.get_num_threads()`` threads."""
    count = gaussians.means.shape[0]
    on_image = memory.several(((count, 2), np.float32), (count, np.bool_))
    # the kernels write to the array; the tensor is an input so that a gradient can reach it
    centres = torch.from_numpy(on_image[0])
    if wanted.means2d_grad:
        centres.requires_grad_()
    image, labels, alpha, depth, *more = _Blend.apply(*gaussians, centres, pinhole, on_image, wanted)
    return Rendering(
        image=image,
        labels=labels if gaussians.labels is not None else None,
        alpha=alpha,
        depth=depth,
        visible=torch.from_numpy(on_image[1]),
        means2d=centres,
        top_indices=more[0] if wanted.top_k else None,
        top_weights=more[1] if wanted.top_k else None,
        surface=more[-1] if wanted.surface else None,
    )


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, scales: Tensor, quats: Tensor, opacities: Tensor, colours: Tensor,
        labels: Tensor | None, centres: Tensor, pinhole: Pinhole, on_image: tuple[Array, Array], wanted: Wanted,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        gaussians = arrays.Gaussians(*map(as_array, (means, scales, quats, opacities, colours)))
        features = as_array(labels) if labels is not None else np.empty((means.shape[0], 0), np.float32)
        is_compiled = log_compilation("the forward pass of the rasteriser", COMPILATION)
        layers, state = rasterize_forward(gaussians, features, pinhole, on_image)
        is_compiled()
        more, shape = list[Tensor](), (pinhole.height, pinhole.width)
        if wanted.top_k:
            more = [torch.full((*shape, wanted.top_k), -1, dtype=torch.int32), torch.zeros((*shape, wanted.top_k))]
            _for_contributors(list_contributors, state, *(each.numpy() for each in more))
        if wanted.surface:
            more.append(torch.empty(shape, dtype=torch.float32))
            reach = np.array(pinhole.surface_reach, np.float32)
            _for_contributors(find_surface, state, arrays.flat(more[-1].numpy()), pinhole.width, reach)
        ctx.mark_non_differentiable(*more)
        ctx.save_for_backward(means, scales, quats)
        ctx.state = state
        ctx.size, ctx.labels_shape = (pinhole.height, pinhole.width), features.shape
        ctx.set_materialize_grads(False)  # `backward` gets None, not zeros, for layers without a loss
        return *map(torch.from_numpy, layers), *more

    @staticmethod
    def backward(ctx: Any, *by: Tensor | None) -> tuple[Tensor | None, ...]:
        size, needed, (d_image, d_labels, d_alpha, d_depth) = ctx.size, ctx.needs_input_grad, by[:4]
        wanted_labels = d_labels if needed[LABELS] else None
        images = (d_image, (*size, 3)), (wanted_labels, (*size, 0)), (d_alpha, size), (d_depth, size)
        # torch gives None if no loss uses a layer: then zeros.
        d_layers = Layers(*(_zeros(shape) if each is None else as_array(each) for each, shape in images))
        shapes = arrays.Shapes(*map(as_array, ctx.saved_tensors))
        is_compiled = log_compilation("the backward pass of the rasteriser", COMPILATION)
        gradients = list(rasterize_backward(ctx.state, shapes, d_layers))
        is_compiled()
        if d_labels is None:
            gradients[LABELS] = np.zeros(ctx.labels_shape, np.float32)
        wanted = zip(gradients, needed, strict=False)  # `needed` also covers the last three arguments
        return *(torch.from_numpy(gradient) if need else None for gradient, need in wanted), None, None, None


@lru_cache(maxsize=2)
def _zeros(shape: tuple[int, ...]) -> Array:
    """Return zeros that calls share and only read. (Marked as read-only, they would make Numba compile again.)"""
    return np.zeros(shape, np.float32)
