"""Pseudo labels for self-training (paper, section "Self-training with Consistency-enhanced Segments")."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene import VOID, PanopticMask

LEAST_AREA = 16
"""Pixels that a region needs to decide on one class."""


def regions(mask: PanopticMask) -> NDArray[np.int32]:
    """{R_m}: connected regions of equal class, over 4 neighbours. int32 [H, W], 0 = void, 1.. regions."""
    classes = mask.class_map()
    result = np.zeros(classes.shape, np.int32)
    count = 0
    for value in np.unique(classes[classes != VOID]):
        number, parts = cv2.connectedComponents((classes == value).astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
        np.copyto(result, parts + count, where=parts > 0)
        count += number - 1
    return result


def pseudo_labels(mask: PanopticMask, rendered_class: NDArray[np.int32]) -> NDArray[np.int32]:
    """s_pse: each region takes the majority of the rendered classes in it; int32 [H, W], 0 = no supervision.

    ``rendered_class`` int32 [H, W]; 0 = nothing rendered, which does not vote. Ties go to the lower id. Regions of
    fewer than LEAST_AREA pixels keep the rendered class pixel by pixel; void regions stay 0.
    """
    region = regions(mask)
    count = int(region.max(initial=0)) + 1
    ids, column = np.unique(rendered_class, return_inverse=True)
    votes = np.bincount(region.reshape(-1) * len(ids) + column.reshape(-1), minlength=count * len(ids))
    votes = votes.reshape(count, len(ids))
    area = votes.sum(1)
    votes[:, ids == VOID] = 0
    winner = np.where(votes.any(1), ids[votes.argmax(1)], VOID).astype(np.int32)
    winner[0] = VOID
    small = (area < LEAST_AREA)[region] & (region > 0)
    return np.where(small, rendered_class, winner[region]).astype(np.int32)
