"""The back end ``numba``: the kernels strung together as a ``torch.autograd.Function``."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from . import gather, projection, tiles, vector_backward, vector_forward
from .conventions import View
from .interface import Rendering
from .records import CHUNK, GRADIENT_WIDTH, RECORD, TILE


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
    if top_k:
        raise NotImplementedError("top_k: only the back end reference so far")
    handle = torch.zeros((means.shape[0], 2), dtype=torch.float32, requires_grad=want_means2d_grad)
    image, labels_out, alpha, depth, visible = _Blend.apply(
        means, scales, quats, opacities, colours, labels, handle, view
    )
    return Rendering(
        image=image,
        labels=labels_out if labels is not None else None,
        alpha=alpha,
        depth=depth,
        visible=visible,
        means2d=handle,
    )


def camera_array(view: View) -> np.ndarray:
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


def worker_count() -> int:
    """As many workers as torch has threads; numba is told so."""
    workers = max(1, min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    numba.set_num_threads(workers)
    return workers


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, scales, quats, opacities, colours, labels, handle, view):
        workers = worker_count()
        camera = camera_array(view)
        inputs = [_array(tensor) for tensor in (means, scales, quats, opacities)]
        count, width, height = means.shape[0], view.width, view.height
        features = _array(labels) if labels is not None else np.empty((count, 0), np.float32)
        records = np.empty((count, RECORD), np.float32)
        boxes = np.empty((count, 4), np.int32)
        counts = np.zeros((workers, 2), np.int64)
        projection.project_all(
            workers, *inputs, _array(colours), camera, width, height, records, boxes, counts
        )

        shown, touched = (int(total) for total in counts.sum(0))
        keys, spare_keys = np.empty(shown, np.uint32), np.empty(shown, np.uint32)
        ids, order = np.empty(shown, np.int32), np.empty(shown, np.int32)
        slots = np.empty(count + 1, np.int64)
        tiles.list_all_visible(workers, boxes, records, counts, keys, ids, slots)
        visible = torch.zeros(count, dtype=torch.bool)
        visible.numpy()[ids] = True
        handle.detach().numpy()[ids] = records[ids][:, [0, 2]]
        histograms = np.empty((workers, tiles.DIGITS), np.int64)
        tiles.sort_by_depth(workers, keys, ids, spare_keys, order, histograms)
        columns, rows = -(-width // TILE), -(-height // TILE)
        tile_ids, tile_slots = np.empty(touched, np.int32), np.empty(touched, np.int32)
        histograms = np.empty((workers, columns * rows), np.int64)
        starts = tiles.deal_all_tiles(workers, order, boxes, slots, columns, histograms, tile_ids, tile_slots)

        image = torch.empty((height, width, 3), dtype=torch.float32)
        channels = features.shape[1]
        labels_out = torch.empty((height, width, channels), dtype=torch.float32)
        alpha, depth = torch.empty((height, width)), torch.empty((height, width))
        rest = np.empty(height * width, np.float32)
        last = np.empty(height * width, np.float32)
        vector_forward.blend_all(
            workers,
            np.zeros(1, np.int64),
            starts,
            tile_ids,
            records.reshape(-1),
            features.reshape(-1),
            channels,
            width,
            height,
            image.numpy().reshape(-1),
            labels_out.numpy().reshape(-1),
            alpha.numpy().reshape(-1),
            depth.numpy().reshape(-1),
            rest,
            last,
            np.empty((workers, vector_forward.scratch_size(channels)), np.float32),
            np.empty((workers, TILE * CHUNK), np.int32),
            np.empty((workers, TILE), np.int64),
        )
        ctx.mark_non_differentiable(visible)
        ctx.save_for_backward(means, scales, quats, opacities)
        ctx.state = (camera, records, slots, starts, tile_ids, tile_slots, rest, last)
        ctx.has_labels = labels is not None
        return image, labels_out, alpha, depth, visible

    @staticmethod
    def backward(ctx, d_image, d_labels, d_alpha, d_depth, _):
        workers = worker_count()
        camera, records, slots, starts, tile_ids, tile_slots, rest, last = ctx.state
        means, scales, quats, _opacities = (_array(tensor) for tensor in ctx.saved_tensors)
        count, touches = means.shape[0], tile_ids.shape[0]
        wants_labels = ctx.has_labels and ctx.needs_input_grad[5]
        height, width = d_alpha.shape
        d_features = _array(d_labels) if wants_labels else np.empty((0, 0, 0), np.float32)
        channels = d_features.shape[2]
        padded = vector_forward.padded_channels(channels)
        touched = np.empty(touches, np.uint8)
        slot_gradients = np.empty(touches * GRADIENT_WIDTH, np.float32)
        slot_labels = np.empty(touches * padded, np.float32)
        vector_backward.unblend_all(
            workers,
            np.zeros(1, np.int64),
            starts,
            tile_ids,
            tile_slots,
            records.reshape(-1),
            rest,
            last,
            _array(d_image).reshape(-1),
            d_features.reshape(-1),
            channels,
            _array(d_alpha).reshape(-1),
            _array(d_depth).reshape(-1),
            width,
            height,
            touched,
            slot_gradients,
            slot_labels,
            np.empty((workers, vector_backward.scratch_size(channels)), np.float32),
            np.empty((workers, TILE * CHUNK), np.int32),
            np.empty((workers, TILE), np.int64),
        )
        shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, channels), (count, 2))
        gradients = [torch.empty(shape, dtype=torch.float32) for shape in shapes]
        gather.gather_all(
            workers,
            slots,
            touched,
            slot_gradients,
            slot_labels,
            records,
            means,
            scales,
            quats,
            camera,
            *(gradient.numpy() for gradient in gradients),
        )
        wanted = [
            gradient if need else None
            for gradient, need in zip(gradients, ctx.needs_input_grad[:7], strict=True)
        ]
        if not wants_labels:
            wanted[5] = None
        return (*wanted, None)
