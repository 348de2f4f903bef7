"""What is particular to a photo and not to the room: its exposure and its sharpness."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

LARGEST_GAIN = 3.0
"""Of a photo against the model, and its inverse the least."""
NEIGHBOURS = 4
"""Photos on either side that a photo's sharpness is compared with: they show about the same."""
LEAST_WEIGHT = 0.1


def exposure_gain(image: torch.Tensor, photo: NDArray[np.float32], border: torch.Tensor | None) -> torch.Tensor:
    """The gain [3] of each channel by which a picture [H, W, 3] comes nearest to a photo float32 [H, W, 3], both
    sRGB-encoded; no gradient flows to it.

    Auto exposure and white balance multiply light, which is nearly a gain of encoded values too.
    """
    shown, target = image.detach(), torch.from_numpy(photo)
    if border is not None:
        shown = shown * ~border[..., None]
    product, square = (shown * target).sum(dim=(0, 1)), (shown * shown).sum(dim=(0, 1))
    return (product / square.clamp_min(1e-6)).clamp(1.0 / LARGEST_GAIN, LARGEST_GAIN)


def sharpness_weights(photos: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """How much each photo uint8 [H, W, 3], in recording order, counts for the picture: float64 [N] in (0, 1].

    A photo blurred by motion has less detail than its neighbours, which show about the same. Detail is the mean
    absolute Laplacian over the mean brightness, so that exposure does not matter.
    """
    detail = np.array([_detail(photo) for photo in photos])
    weights = np.ones(len(photos))
    for index, own in enumerate(detail):
        around = detail[max(index - NEIGHBOURS, 0) : index + NEIGHBOURS + 1]
        weights[index] = np.clip((own / max(float(np.median(around)), 1e-9)) ** 2, LEAST_WEIGHT, 1.0)
    return weights


def _detail(photo: NDArray[np.uint8]) -> float:
    grey = photo.mean(axis=2, dtype=np.float32)
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean() / (grey.mean() + 1.0))
