"""The loss on rendered depth (ours: the paper's geometry is supervised by pictures alone)."""

from __future__ import annotations

import torch

NEAR = 0.5
"""Metres: nearer than this an error counts as much as at this depth."""
NOISY = 4.0
"""Metres: at this depth a sensor's noise, which grows as depth squared, halves the weight of a pixel."""


def depth_loss(depth: torch.Tensor, alpha: torch.Tensor, sensor: torch.Tensor) -> torch.Tensor:
    """Mean over the pixels with depth of min(1, (|D - alpha d| + (1 - alpha) d / 2) / max(d, NEAR)), weighted by the
    sensor's noise; 0 where no pixel has depth.

    ``depth`` D float32 [H, W] is the unnormalised rendered depth in metres, ``alpha`` [H, W] the coverage, ``sensor`` d
    [H, W] metres, 0 = none. The share of the depth makes it robust: what is wrong by all of its depth counts once.
    """
    known = sensor > 0
    if not bool(known.any()):
        return depth.sum() * 0.0
    gap = (depth - alpha * sensor).abs() + 0.5 * (1.0 - alpha) * sensor
    weight = known / (1.0 + (sensor / NOISY) ** 2)
    return ((gap / sensor.clamp_min(NEAR)).clamp_max(1.0) * weight).sum() / weight.sum()
