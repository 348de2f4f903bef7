"""An identity encoding (Gaussian Grouping): blended encodings are classified by the ids of tracked masks, and Gaussians
near each other should be classified alike."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch.nn import functional

from .encodings import EncodedDecoders

TINY = 1e-10
MOST_POINTS = 200_000
"""How many Gaussians neighbours are searched among."""


CHANNELS = 16
"""Numbers of an encoding."""
NEIGHBOURS, SAMPLES = 5, 1000
"""Each Gaussian is compared with this many nearest ones, itself included."""
NEIGHBOUR_WEIGHT = 2.0
"""Weight of the difference."""
NEIGHBOUR_EVERY = 5
"""They are compared in each step that trains labels whose number, among those, this divides."""


def identity_loss(
    blended: torch.Tensor, alpha: torch.Tensor, slot: torch.Tensor, decoders: EncodedDecoders
) -> torch.Tensor:
    """Cross-entropy of the classified encodings, over the logarithm of the number of slots: mean over the pixels that
    have a slot.

    ``blended`` [H, W, E] up to ``alpha`` [H, W], which is only a divisor: no gradient reaches it. ``slot`` int [H, W],
    -1 = unknown. 0 without any.
    """
    known = slot >= 0
    if not bool(known.any()):
        return blended.sum() * 0.0
    logits = decoders.slot_logits(blended[known], alpha.detach()[known])
    return functional.cross_entropy(logits, slot[known].long()) / math.log(max(logits.shape[1], 2))


def neighbour_loss(
    means: torch.Tensor, encodings: torch.Tensor, decoders: EncodedDecoders, random: np.random.Generator
) -> torch.Tensor:
    """KL divergence of what the classifier says about a Gaussian from what it says about its nearest: mean over a
    sample, divided by the number of slots. ``means`` [N, 3] metres (no gradient), ``encodings`` [N, E]."""
    if not len(means):
        return encodings.sum() * 0.0
    rows = np.sort(random.permutation(len(means))[:MOST_POINTS])
    points = means.detach().numpy()[rows]
    sample = random.permutation(len(rows))[:SAMPLES]
    near = cKDTree(points).query(points[sample], k=list(range(1, min(NEIGHBOURS, len(rows)) + 1)))[1]
    mine, theirs = (torch.softmax(decoders.classifier(_rows(encodings, rows[each])), dim=-1) for each in (sample, near))
    apart = mine[:, None] * (torch.log(mine[:, None] + TINY) - torch.log(theirs + TINY))
    return apart.sum(dim=-1).mean() / mine.shape[-1]


def _rows(encodings: torch.Tensor, rows: NDArray[np.int64]) -> torch.Tensor:
    """``encodings`` of rows of any shape. Gradients of a row taken twice add up in one order, unlike indexing's."""
    taken = encodings.index_select(0, torch.from_numpy(rows.reshape(-1)))
    return taken.view(*rows.shape, encodings.shape[1])
