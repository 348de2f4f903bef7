"""The decoders' weights in one flat array, laid out as the kernels read them; and gradients back from it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..decoders import HIDDEN, Decoders, DecoderShape

LANES = 16
"""Columns of a vector. Columns are padded to whole vectors."""
BATCH = 64
"""Anchors that a kernel takes at once. Their inputs, hidden layers and outputs stay in the nearest caches."""
ROUND_ROWS = 8
"""Rows of a block of the matrix product. Rows are padded to a multiple of it."""


class Head(NamedTuple):
    """One decoder: how many of the inputs it reads, its outputs, and where in the packed array its parts begin.

    ``first`` [inputs, HIDDEN], ``first_bias`` [HIDDEN], ``last`` [HIDDEN, padded], ``last_bias`` [padded] are also the
    places of their gradients. ``first_back`` [HIDDEN, padded features] and ``last_back`` [outputs, HIDDEN] are the same
    weights transposed, for the backward pass.
    """

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
"""Places in ``Heads``."""


class Sizes(NamedTuple):
    """What the kernels need to know of the shapes, and where the parts of a worker's scratch begin, in floats.

    A row of inputs, of which scratch holds a batch first, is feature, direction, distance (if wanted) and zeros:
    ``inputs`` floats.
    """

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
    """``parameters`` floats that have gradients come first in the packed array of ``size`` floats."""

    heads: Heads
    sizes: Sizes
    parameters: int
    size: int


def _rounded(count: int, unit: int) -> int:
    return -(-count // unit) * unit


@cache
def layout_of(shape: DecoderShape) -> Layout:
    """Where everything lies, for decoders of ``shape``."""
    k, seen = shape.gaussians_per_anchor, shape.features + shape.view_inputs
    labelled = seen if shape.label_view_input else shape.features
    padded_features = _rounded(shape.features, LANES)
    sides = [(seen, k), (seen, 7 * k), (seen, 3 * k)]
    sides += [(labelled, shape.classes * k), (labelled, shape.instance_slots * k)]
    at, places = 0, []
    for inputs, outputs in sides:
        padded = _rounded(outputs, LANES)
        counts = (_rounded(inputs, ROUND_ROWS) * HIDDEN, HIDDEN, HIDDEN * padded, padded)
        starts = [at + sum(counts[:place]) for place in range(4)]
        at += sum(counts)
        places.append((inputs, outputs, padded, *starts))
    parameters, heads = at, []
    for place in places:
        heads.append(Head._make((*place, at, at + HIDDEN * padded_features)))
        at += HIDDEN * (padded_features + place[1])
    inputs = _rounded(seen, ROUND_ROWS)
    widths = (inputs, HIDDEN, HIDDEN, padded_features, max(head.padded for head in heads))
    begins = [BATCH * sum(widths[:place]) for place in range(len(widths) + 1)]
    sizes = Sizes(
        features=shape.features,
        padded_features=padded_features,
        distance=int(shape.distance_input),
        k=k,
        classes=shape.classes,
        slots=shape.instance_slots,
        inputs=inputs,
        hidden_at=begins[1],
        d_hidden_at=begins[2],
        d_inputs_at=begins[3],
        out_at=begins[4],
        scratch=begins[5],
    )
    return Layout(Heads(*heads), sizes, parameters, at)


def parameters_of(decoders: Decoders) -> list[torch.Tensor]:
    """Weight and bias of the first and of the last layer of each decoder, in the order of ``Heads``."""
    mlps = (decoders.opacity, decoders.covariance, decoders.colour, decoders.semantic, decoders.instance)
    return [mlp.get_parameter(name) for mlp in mlps for name in ("0.weight", "0.bias", "2.weight", "2.bias")]


def _views(packed: NDArray[Any], head: Head) -> Iterator[NDArray[Any]]:
    """The four parts of a head that have gradients, shaped as torch has them (weights [outputs, inputs])."""
    yield packed[head.first : head.first_bias].reshape(-1, HIDDEN)[: head.inputs].T
    yield packed[head.first_bias : head.last]
    yield packed[head.last : head.last_bias].reshape(HIDDEN, head.padded)[:, : head.outputs].T
    yield packed[head.last_bias : head.last_bias + head.outputs]


def packed(parameters: list[torch.Tensor], layout: Layout) -> NDArray[np.float32]:
    """The decoders' parameters, in the order of ``parameters_of``, as one array float32 [layout.size]."""
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
    """Gradients in the order of ``parameters_of`` from the packed one, float32 [layout.parameters]."""
    return [torch.from_numpy(view.copy()) for head in layout.heads for view in _views(gradient, head)]
