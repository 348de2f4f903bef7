"""What the decoders' kernels take and fill, as named tuples. All arrays are flat; M anchors, V of them visible, k
Gaussians each, of which N are drawn."""

from __future__ import annotations

from typing import Any, NamedTuple

from ...machine.compiled import Array


class AnchorArrays(NamedTuple):
    """``visible`` int64 [V]: rows of the others; ``feature`` [M * F]; ``position`` [M * 3] and ``centre`` [3] (of the
    camera) in metres; ``offset`` [M * k * 3]; ``log_scale`` [M * 6]. float32."""

    visible: Array
    feature: Array
    position: Array
    centre: Array
    offset: Array
    log_scale: Array


class Packed(NamedTuple):
    """``weights`` float32 as ``packing.packed`` lays them out, ``heads`` int64 [5, 9] its ``Heads``, ``sizes`` its
    ``Sizes``."""

    weights: Array
    heads: Array
    sizes: Any


class Labelling(NamedTuple):
    """``channels`` int64 [M] or empty: the channel of each anchor's class for the cluster loss, -1 for none. ``known``
    float32 [M * k * known_channels]: labels to show instead of decoding them; empty to decode them."""

    channels: Array
    known: Array
    known_channels: int


class Batches(NamedTuple):
    """``opacities`` float32 [V * k] of all Gaussians, drawn or not. Each batch of anchors has the number of its first
    drawn Gaussian in ``starts`` int64, and its sum of L_cluster in ``losses`` float64."""

    opacities: Array
    starts: Array
    losses: Array


class Drawn(NamedTuple):
    """The Gaussians drawn, or their gradients, float32: ``means`` and ``scales`` [N * 3], ``quats`` [N * 4],
    ``opacities`` [N], ``colours`` [N * 3], ``labels`` [N * (C + S)]."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colours: Array
    labels: Array


class Gradients(NamedTuple):
    """Given: ``by``, the gradients of the Gaussians ``drawn``, and ``by_loss``, that of one Gaussian's cross entropy.

    Filled: the gradients of ``feature``, ``offset`` and ``log_scale``, shaped as in ``AnchorArrays`` and zero before;
    and of the ``weights`` [chunks, parameters], a row for each chunk of batches.
    """

    drawn: Drawn
    by: Drawn
    by_loss: float
    feature: Array
    offset: Array
    log_scale: Array
    weights: Array


class Work(NamedTuple):
    """Room to work in. ``next_one`` int64 [1] is the next batch, or chunk of batches, to take. Each worker has
    ``floats`` float32 [workers, Sizes.scratch] and ``numbers`` int64 [workers, BATCH * (1 + 2 k)]."""

    next_one: Array
    floats: Array
    numbers: Array


class Batch(NamedTuple):
    """Anchors decoded together: their ``rows`` places in ``visible``. The first ``drawing`` of them draw a Gaussian,
    the rest only take part in the cluster loss. ``gaussians`` are drawn, numbered from ``first`` on; the one m places
    after that is number owners[2 * m + 1] of row owners[2 * m]."""

    listed: Array
    rows: int
    drawing: int
    owners: Array
    first: int
    gaussians: int
