"""The back end ``numba``: the kernels strung together as a ``torch.autograd.Function``."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from . import blend_backward, blend_forward, gather, projection, tiles
from .conventions import View
from .interface import Rendering
from .records import GRADIENT, RECORD, TILE


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
        labels_out = torch.empty((height, width, features.shape[1]), dtype=torch.float32)
        alpha, depth = torch.empty((height, width)), torch.empty((height, width))
        rest = np.empty((height, width), np.float32)
        last = np.empty((height, width), np.int32)
        blend_forward.blend_all(
            workers,
            starts,
            tile_ids,
            records,
            features,
            image.numpy(),
            labels_out.numpy(),
            alpha.numpy(),
            depth.numpy(),
            rest,
            last,
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
        d_features = _array(d_labels) if wants_labels else np.empty((*rest.shape, 0), np.float32)
        channels = d_features.shape[2]
        touched = np.empty(touches, np.uint8)
        slot_gradients = np.empty((touches, GRADIENT), np.float32)
        slot_labels = np.empty((touches, channels), np.float32)
        blend_backward.unblend_all(
            workers,
            starts,
            tile_ids,
            tile_slots,
            records,
            rest,
            last,
            _array(d_image),
            d_features,
            _array(d_alpha),
            _array(d_depth),
            touched,
            slot_gradients,
            slot_labels,
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
