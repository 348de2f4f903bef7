"""The data of the decoder kernels: all weights packed into one flat array (gradients likewise), and named tuples of the
other arrays. All arrays are flat. Of M anchors V are visible, with k Gaussians each; N of these are drawn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...machine.compiled import Array
from ..decoders import HIDDEN, Decoders, DecoderShape

LANES = 16
"""Columns of a SIMD vector. Columns are padded to whole vectors."""
BATCH = 64
"""Anchors that a kernel processes at once. Their inputs, hidden layers and outputs fit into the nearest caches."""
ROUND_ROWS = 8
"""Rows of a block of the matrix product. Rows are padded to a multiple of it."""


class Head(NamedTuple):
    """One decoder: its numbers of inputs and outputs, and where its parts begin in the packed array. ``first`` [inputs,
    HIDDEN], ``first_bias`` [HIDDEN], ``last`` [HIDDEN, padded] and ``last_bias`` [padded] are also where their
    gradients begin. ``first_back`` [HIDDEN, padded features] and ``last_back`` [outputs, HIDDEN] are the same weights
    transposed, for the backward pass."""

    inputs: int
    outputs: int
    padded: int
    first: int
    first_bias: int
    last: int
    last_bias: int
    first_back: int
    last_back: int


class Heads(NamedTuple):
    opacity: Head
    covariance: Head
    colour: Head
    semantic: Head
    instance: Head


OPACITY, COVARIANCE, COLOUR, SEMANTIC, INSTANCE = range(5)
"""Indices in ``Heads``."""


class Sizes(NamedTuple):
    """The sizes of the kernels' arrays, and where the parts of a worker's scratch begin, in floats. It begins with a
    batch of input rows of ``inputs`` floats each: feature, direction, distance (if used) and zeros."""

    features: int
    padded_features: int
    distance: int
    k: int
    classes: int
    slots: int
    inputs: int
    hidden_at: int
    d_hidden_at: int
    d_inputs_at: int
    out_at: int
    scratch: int


class Layout(NamedTuple):
    """The layout of the packed array: ``size`` floats in all, of which the first ``parameters`` have gradients."""

    heads: Heads
    sizes: Sizes
    parameters: int
    size: int


def _rounded(count: int, unit: int) -> int:
    return -(-count // unit) * unit


@cache
def layout_of(shape: DecoderShape) -> Layout:
    """Return the layout of the packed array for decoders of ``shape``."""
    padded_features = _rounded(shape.features, LANES)
    at, offsets = 0, []
    for inputs, outputs in Decoders.sides(shape).values():
        padded = _rounded(outputs, LANES)
        counts = (_rounded(inputs, ROUND_ROWS) * HIDDEN, HIDDEN, HIDDEN * padded, padded)
        starts = [at + sum(counts[:part]) for part in range(4)]
        at += sum(counts)
        offsets.append((inputs, outputs, padded, *starts))
    parameters, heads = at, []
    for one in offsets:
        heads.append(Head._make((*one, at, at + HIDDEN * padded_features)))
        at += HIDDEN * (padded_features + one[1])
    inputs = _rounded(shape.features + shape.view_inputs, ROUND_ROWS)
    widths = (inputs, HIDDEN, HIDDEN, padded_features, max(head.padded for head in heads))
    begins = [BATCH * sum(widths[:part]) for part in range(len(widths) + 1)]
    sizes = Sizes(
        features=shape.features, padded_features=padded_features, distance=int(shape.distance_input),
        k=shape.gaussians_per_anchor, classes=shape.classes, slots=shape.instance_slots, inputs=inputs,
        hidden_at=begins[1], d_hidden_at=begins[2], d_inputs_at=begins[3], out_at=begins[4], scratch=begins[5],
    )  # fmt: skip
    return Layout(Heads(*heads), sizes, parameters, at)


def parameters_of(decoders: Decoders) -> list[torch.Tensor]:
    """Return each decoder's first weight and bias, then its last ones, decoders in the order of ``Heads``."""
    mlps = (decoders.opacity, decoders.covariance, decoders.colour, decoders.semantic, decoders.instance)
    return [mlp.get_parameter(name) for mlp in mlps for name in ("0.weight", "0.bias", "2.weight", "2.bias")]


def _views(packed: NDArray[Any], head: Head) -> Iterator[NDArray[Any]]:
    """Yield views of the four parts of a head that have gradients, in torch's shapes (weights [outputs, inputs])."""
    yield packed[head.first : head.first_bias].reshape(-1, HIDDEN)[: head.inputs].T
    yield packed[head.first_bias : head.last]
    yield packed[head.last : head.last_bias].reshape(HIDDEN, head.padded)[:, : head.outputs].T
    yield packed[head.last_bias : head.last_bias + head.outputs]


def packed(parameters: list[torch.Tensor], layout: Layout) -> NDArray[np.float32]:
    """Return the parameters, ordered as by ``parameters_of``, packed into one array, float32 [layout.size]."""
    flat = np.zeros(layout.size, np.float32)
    arrays = [parameter.detach().numpy() for parameter in parameters]
    features = layout.sizes.padded_features
    for number, head in enumerate(layout.heads):
        own = arrays[4 * number : 4 * number + 4]
        for view, array in zip(_views(flat, head), own, strict=True):
            view[...] = array
        width = min(layout.sizes.features, head.inputs)
        flat[head.first_back : head.last_back].reshape(HIDDEN, features)[:, :width] = own[0][:, :width]
        flat[head.last_back : head.last_back + HIDDEN * head.outputs] = own[2].reshape(-1)
    return flat


def unpacked(gradient: NDArray[np.float32], layout: Layout) -> list[torch.Tensor]:
    """Return the parameters' gradients, ordered as by ``parameters_of``, given packed, float32 [layout.parameters]."""
    return [torch.from_numpy(view.copy()) for head in layout.heads for view in _views(gradient, head)]


class AnchorArrays(NamedTuple):
    """The anchors as float32 arrays: ``feature`` [M * F], ``position`` [M * 3] metres, ``offset`` [M * k * 3],
    ``log_scale`` [M * 6]. ``visible`` int64 [V]: the anchors in view; ``centre`` [3]: the camera's, metres."""

    visible: Array
    feature: Array
    position: Array
    centre: Array
    offset: Array
    log_scale: Array


class Packed(NamedTuple):
    """All decoders: ``weights`` float32 as ``packed`` lays them out, ``heads`` int64 [5, 9] (``Heads``), ``sizes``."""

    weights: Array
    heads: Array
    sizes: Any


class Labelling(NamedTuple):
    """For labels: ``channels`` int64 [M]: the channel of each anchor's class for the cluster loss, -1 = none; empty
    without that loss. ``known`` float32 [M * k * known_channels]: labels to use instead of decoding them; empty to
    decode."""

    channels: Array
    known: Array
    known_channels: int


class Batches(NamedTuple):
    """All Gaussians' ``opacities`` float32 [V * k], drawn or not, and by batch of anchors: ``starts`` int64, the index
    of its first drawn Gaussian, and ``losses`` float64, its sum of L_cluster."""

    opacities: Array
    starts: Array
    losses: Array


class Decoding(NamedTuple):
    """The input of the decoding kernels: the anchors, the decoders, the labels, and the division into batches."""

    anchors: AnchorArrays
    packed: Packed
    labelling: Labelling
    batches: Batches


class Drawn(NamedTuple):
    """The drawn Gaussians, or their gradients, float32: ``means`` and ``scales`` [N * 3], ``quats`` [N * 4],
    ``opacities`` [N], ``colours`` [N * 3], ``labels`` [N * (C + S)]."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colours: Array
    labels: Array


class Gradients(NamedTuple):
    """Input of the backward pass: gradients ``by`` the Gaussians ``drawn``, and ``by_loss``, by each Gaussian's cross
    entropy. Output: those of ``feature``, ``offset`` and ``log_scale``, as in ``AnchorArrays``, 0 before; and of the
    ``weights`` [chunks, parameters], a row for each chunk of batches."""

    drawn: Drawn
    by: Drawn
    by_loss: float
    feature: Array
    offset: Array
    log_scale: Array
    weights: Array


class Work(NamedTuple):
    """The workers' working memory: ``floats`` float32 [workers, Sizes.scratch] and ``numbers`` int64 [workers, BATCH *
    (1 + 2 k)]. ``next_one`` int64 [1], shared: the next batch, or chunk of batches, to take."""

    next_one: Array
    floats: Array
    numbers: Array


class Batch(NamedTuple):
    """Anchors that are decoded together. ``listed`` has their places in the list of visible anchors; ``rows`` is their
    number. The first ``drawing`` of them draw a Gaussian; the others only have a cluster loss. The number of drawn
    Gaussians is ``gaussians``; the m-th is drawn Gaussian ``first`` + m of the view, made by anchor listed[owners[2 m]]
    as its Gaussian owners[2 m + 1]."""

    listed: Array
    rows: int
    drawing: int
    owners: Array
    first: int
    gaussians: int
