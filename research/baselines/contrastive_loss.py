"""Contrastive Lift's loss: pixels of one segment of the input masks have like embeddings, those of two segments of a
view differ.

It is not known which segments of different views are the same object. Embeddings are blended twice: as the instance
decoder gives them ("fast"), and as a decoder that follows it slowly does ("slow"), to compare with.
"""

from __future__ import annotations

import numpy as np
import torch

from engine.train.assignment import ThingSegments

TINY = 1e-8


CHANNELS = 3
"""Numbers of an embedding."""
MOMENTUM = 0.9
"""How much of itself the slow decoder keeps in a step that trains labels."""
PIXELS = 2048
"""Pixels of a view that are compared in a step."""


def contrastive_loss(
    blended: torch.Tensor, alpha: torch.Tensor, things: ThingSegments, random: np.random.Generator
) -> torch.Tensor:
    """The loss of at most PIXELS pixels of thing segments: half of them by their fast embeddings, the others by their
    slow ones.

    ``blended`` [H, W, 2 E], fast, then slow, up to ``alpha`` [H, W]; gradients reach only the fast ones. 0 with fewer
    than two pixels.
    """
    inside = np.flatnonzero(things.row.reshape(-1) >= 0)
    if len(inside) < 2:
        return blended.sum() * 0.0
    chosen = random.permutation(inside)[:PIXELS]
    segment = torch.from_numpy(things.row.reshape(-1)[chosen].astype(np.int64))
    rows, half, channels = torch.from_numpy(chosen), len(chosen) // 2, blended.shape[-1] // 2
    embedded = blended.reshape(-1, 2 * channels)[rows] / (alpha.detach().reshape(-1, 1)[rows] + TINY)
    fast, slow = embedded[:half, :channels], embedded[half:, channels:].detach()
    is_one = segment[:half, None] == segment[None, half:]
    return concentration(fast, slow, segment[:half], is_one) + contrast(fast, slow, is_one)


def concentration(fast: torch.Tensor, slow: torch.Tensor, segment: torch.Tensor, is_one: torch.Tensor) -> torch.Tensor:
    """-exp(-d^2) of the distance d of each fast embedding [N, E] to the mean of the slow ones [M, E] of its segment:
    mean over the pixels of a segment, then over the segments. ``segment`` int64 [N], ``is_one`` bool [N, M]: of one
    segment. Segments without a slow embedding do not count."""
    others = is_one.sum(dim=1)
    known = others > 0
    if not bool(known.any()):
        return fast.sum() * 0.0
    centre = is_one[known].to(slow) @ slow / others[known, None]
    near = torch.exp(-((fast[known] - centre) ** 2).sum(dim=1))
    _, place, count = torch.unique(segment[known], return_inverse=True, return_counts=True)
    return -(near / count[place]).sum() / len(count)


def contrast(fast: torch.Tensor, slow: torch.Tensor, is_one: torch.Tensor) -> torch.Tensor:
    """-log of the share that the slow embeddings [M, E] of its own segment have in the likeness exp(exp(-d)) of a fast
    one [N, E] to all: mean over those that have any. ``is_one`` bool [N, M]."""
    apart = torch.cdist(fast, slow, compute_mode="donot_use_mm_for_euclid_dist")
    like = torch.exp(torch.exp(-apart))
    known = is_one.any(dim=1)
    if not bool(known.any()):
        return fast.sum() * 0.0
    share = (like * is_one).sum(dim=1)[known] / like.sum(dim=1)[known]
    return -torch.log(share).mean()
