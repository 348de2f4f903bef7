"""PQ and mIoU beside those of torchmetrics, which is nobody's of this project, on random labels.

Without void, where the definitions differ: COCO excuses what lies on it, the mode ``strict`` deletes it.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from engine.metrics.panoptic import FrameQuality, PanopticEvaluation
from engine.scene import Category, ClassTable

THINGS, STUFF = (2, 5), (1, 3, 4)
CLASSES = ClassTable(tuple(Category(i, f"class {i}", i in THINGS, (i, i, i)) for i in sorted(THINGS + STUFF)))
SIZE = (24, 32)

Maps = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]


def random_views(seed: int, frames: int) -> list[Maps]:
    """True labels in blocks, and predictions that follow them but for noise, other classes and other ids."""
    random = np.random.default_rng(seed)
    views = []
    for _ in range(frames):
        rows, columns = np.indices(SIZE)
        block = (rows // 8) * 4 + columns // 8
        kind, number = random.choice(CLASSES.ids, 12), random.integers(0, 4, 12)
        guess = np.where(random.random(12) < 0.25, random.choice(CLASSES.ids, 12), kind)
        name = np.where(random.random(12) < 0.25, random.integers(0, 4, 12), number)
        moved = np.where(random.random(SIZE) < random.choice([0.0, 0.2, 0.5]), random.integers(0, 12, SIZE), block)
        maps = [kind[block], number[block], guess[moved], name[moved]]
        for classes, ids in ((maps[0], maps[1]), (maps[2], maps[3])):
            ids[~np.isin(classes, THINGS)] = 0
        true_class, true_id, classes, ids = (each.astype(np.int32) for each in maps)
        views.append((classes, ids, true_class, true_id))
    return views


def panoptic_quality(pairs: list[tuple[NDArray[np.int32], NDArray[np.int32]]]) -> float:
    """By torchmetrics, of predicted and true (class, instance) pictures [H, W, 2]."""
    from torchmetrics.detection import PanopticQuality  # takes seconds to import

    metric = PanopticQuality(set(THINGS), set(STUFF), allow_unknown_preds_category=True)
    for predicted, true in pairs:
        metric.update(torch.from_numpy(predicted)[None], torch.from_numpy(true)[None])
    return float(metric.compute())


@pytest.mark.parametrize("seed", range(12))
def test_random_labels_have_the_same_scores(seed: int) -> None:
    from torchmetrics.classification import MulticlassJaccardIndex

    views = random_views(seed, frames=1 + seed % 4)
    scene, frames = PanopticEvaluation(CLASSES, "strict"), FrameQuality(CLASSES)
    for view in views:
        frames.add(scene.add(*view))
    pairs = [(np.stack(view[:2], axis=-1), np.stack(view[2:], axis=-1)) for view in views]
    whole = [(np.concatenate([p for p, _ in pairs]), np.concatenate([t for _, t in pairs]))]
    scores = scene.result()
    assert scores.pq == pytest.approx(panoptic_quality(whole), abs=1e-6)
    assert frames.pq == pytest.approx(panoptic_quality(pairs), abs=1e-6)
    classes, true = (torch.from_numpy(each[..., 0]).long() for each in whole[0])
    jaccard = MulticlassJaccardIndex(num_classes=max(CLASSES.ids) + 1)
    assert scores.miou == pytest.approx(float(jaccard(classes, true)), abs=1e-6)
