"""Front-to-back blending in plain torch on any device: all tiles side by side, some Gaussians of each at a time.

The blending rules are those of ``conventions`` and the footprints are whitened as told in ``records``. Per pass
over the lists nothing is kept but the transmittance that enters it; the backward pass computes the rest anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from ..records import TILE, WHITENING

PIXELS = TILE * TILE
PAIRS_AT_ONCE = 1 << 23
"""Pairs of a Gaussian and a pixel that one pass computes: with float32, 32 MB for each of about a dozen tensors."""


@dataclass(frozen=True, eq=False)
class Splats:
    """V projected Gaussians.

    ``centres`` float64 [V, 2], pixels; ``covariances`` float64 [V, 2, 2], pixels squared, blurred;
    ``opacities`` [V]; ``features`` [V, F], blended; ``labels`` [V, C], blended with detached weights. The last
    three are of one float dtype, in which the pixels are computed too.
    """

    centres: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    labels: Tensor


@dataclass(frozen=True, eq=False)
class TileLists:
    """For each tile of an image, row by row, which Gaussians may touch it.

    ``ids`` int64 [E]: rows of the ``Splats``, tile after tile, front to back in each. ``starts`` int64
    [tiles + 1]: tile t has ids[starts[t] : starts[t + 1]]. ``width`` and ``height`` in pixels.
    """

    ids: Tensor
    starts: Tensor
    width: int
    height: int

    @property
    def columns(self) -> int:
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE)


@dataclass(frozen=True, eq=False)
class Blended:
    """``features`` [H, W, F], ``labels`` [H, W, C]; ``top_ids`` int64 [H, W, k], rows of the ``Splats``, and
    ``top_weights`` [H, W, k], largest first, the front one of two equal ones first, -1 and 0 where there are
    fewer."""

    features: Tensor
    labels: Tensor
    top_ids: Tensor
    top_weights: Tensor


def blend_in_torch(splats: Splats, lists: TileLists, top_k: int) -> Blended:
    """Differentiable in all tensors of ``splats``. On the CPU the same bits on every run, whatever the number of
    threads."""
    dtype, device = splats.opacities.dtype, splats.opacities.device
    tiles = torch.arange(lists.rows * lists.columns, device=device)
    corners = torch.stack([tiles % lists.columns, tiles // lists.columns], -1) * TILE
    features = torch.zeros(len(tiles), PIXELS, splats.features.shape[1], dtype=dtype, device=device)
    labels = torch.zeros(len(tiles), PIXELS, splats.labels.shape[1], dtype=dtype, device=device)
    top_ids = torch.full((len(tiles), PIXELS, top_k), -1, device=device)
    top_weights = torch.zeros(len(tiles), PIXELS, top_k, dtype=dtype, device=device)
    whitened = whiten(splats.covariances)
    transmittance = _inside(corners, lists).to(dtype)
    place, end = lists.starts[:-1], lists.starts[1:]
    while True:
        # what has ended or has no more Gaussians drops out; the last pass is an empty one, which also ties the
        # result to its inputs where nothing is drawn at all
        alive = (place < end) & (transmittance > TRANSMITTANCE_END).any(1)
        tiles, transmittance, place, end = tiles[alive], transmittance[alive], place[alive], end[alive]
        depth = _depth_of_pass(place, end)
        positions = place[:, None] + torch.arange(depth, device=device)
        listed = positions < end[:, None]
        ids = lists.ids[torch.where(listed, positions, place[:, None])]
        some_features, some_labels, weights, transmittance = checkpoint(
            _blend_some,
            ids,
            listed,
            corners[tiles],
            transmittance,
            splats,
            whitened,
            use_reentrant=False,
            preserve_rng_state=False,
        )
        features.index_add_(0, tiles, some_features)
        labels.index_add_(0, tiles, some_labels)
        if top_k:
            kept = _keep_largest(top_ids[tiles], top_weights[tiles], ids, weights.detach())
            top_ids[tiles], top_weights[tiles] = kept
        if not len(tiles):
            break
        place = place + depth
    return Blended(*(_image(values, lists) for values in (features, labels, top_ids, top_weights)))


def whiten(covariances: Tensor) -> Tensor:
    """[V, 3]: l11, l12, l22 such that |(l11 dx + l12 dy, l22 dy)|^2 = log2(e) / 2 * d^T inv(cov) d."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    l11 = torch.sqrt(c / (a * c - b * b))
    return WHITENING * torch.stack([l11, -l11 * b / c, torch.rsqrt(c)], -1)


def _inside(corners: Tensor, lists: TileLists) -> Tensor:
    """bool [tiles, PIXELS]: the pixel belongs to the image."""
    across = torch.arange(TILE, device=corners.device)
    columns = corners[:, None, None, 0] + across
    rows = corners[:, None, None, 1] + across[:, None]
    return ((columns < lists.width) & (rows < lists.height)).flatten(1)


def _depth_of_pass(place: Tensor, end: Tensor) -> int:
    """How many Gaussians of each tile the next pass takes."""
    if not len(place):
        return 1
    return max(1, min(PAIRS_AT_ONCE // (len(place) * PIXELS), int((end - place).max())))


def _blend_some(
    ids: Tensor, listed: Tensor, corners: Tensor, transmittance: Tensor, splats: Splats, whitened: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Some Gaussians over some tiles: what they add to the features [t, PIXELS, F] and labels [t, PIXELS, C], their
    weights [t, PIXELS, n] and the transmittance [t, PIXELS] behind them.

    ``ids`` [t, n], of which ``listed`` count; ``corners`` [t, 2], pixels; ``transmittance`` [t, PIXELS].
    """
    opacities = torch.where(listed, splats.opacities[ids], 0.0)
    raw = opacities[:, None, :] * _falloff(
        splats.centres[ids] - corners[:, None, :], whitened[ids], transmittance.dtype
    )
    alpha = raw.clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = transmittance[:, :, None] * torch.cumprod(1.0 - alpha, 2)
    before = torch.cat([transmittance[:, :, None], after[:, :, :-1]], 2)
    weights = torch.where(after > TRANSMITTANCE_END, alpha * before, 0.0)
    return weights @ splats.features[ids], weights.detach() @ splats.labels[ids], weights, after[:, :, -1]


def _falloff(centres: Tensor, whitened: Tensor, dtype: torch.dtype) -> Tensor:
    """[t, PIXELS, n]: exp(-d^2 / 2) of n Gaussians at the pixels of their tiles.

    ``centres`` float64 [t, n, 2] from the tile's corner, ``whitened`` float64 [t, n, 3]. The middle of the tile is
    whitened in float64; from there to a pixel it is a few pixels, for which ``dtype`` is enough.
    """
    l11, l12, l22 = whitened.unbind(-1)
    dx, dy = (TILE / 2 - centres).unbind(-1)
    s1_middle, s2_middle = (l11 * dx + l12 * dy).to(dtype), (l22 * dy).to(dtype)
    across = torch.arange(TILE, dtype=dtype, device=centres.device) - (TILE - 1) / 2
    y, x = (values.reshape(1, PIXELS, 1) for values in torch.meshgrid(across, across, indexing="ij"))
    l11, l12, l22 = (values.to(dtype)[:, None, :] for values in (l11, l12, l22))
    s1 = s1_middle[:, None, :] + l11 * x + l12 * y
    s2 = s2_middle[:, None, :] + l22 * y
    return torch.exp2(-(s1 * s1 + s2 * s2))


def _keep_largest(top_ids: Tensor, top_weights: Tensor, ids: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Merge ``ids`` [t, n] with their ``weights`` [t, PIXELS, n] into the lists [t, PIXELS, k], which are of
    Gaussians in front of them."""
    new_ids = torch.where(weights > 0.0, ids[:, None, :], -1)
    ordered = torch.sort(torch.cat([top_weights, weights], 2), dim=2, descending=True, stable=True)
    best = ordered.indices[:, :, : top_ids.shape[2]]
    return torch.cat([top_ids, new_ids], 2).gather(2, best), ordered.values[:, :, : top_ids.shape[2]]


def _image(values: Tensor, lists: TileLists) -> Tensor:
    """[tiles, PIXELS, c] to [H, W, c]."""
    blocks = values.reshape(lists.rows, lists.columns, TILE, TILE, values.shape[2])
    image = blocks.transpose(1, 2).reshape(lists.rows * TILE, lists.columns * TILE, values.shape[2])
    return image[: lists.height, : lists.width].contiguous()
