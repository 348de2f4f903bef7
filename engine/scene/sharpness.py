"""How much detail a photo has: less than its neighbours', which show about the same, when it is blurred."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def photo_detail(photo: NDArray[np.uint8]) -> float:
    """The mean absolute Laplacian over the mean brightness, so that exposure does not matter; photo uint8 [H, W, 3]."""
    import cv2

    grey = photo.mean(axis=2, dtype=np.float32)
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean() / (grey.mean() + 1.0))
