"""mIoU and PQ against the published evaluator's values, by hand, and against torchmetrics, an independent program, on
random labels without void: COCO excuses what lies on it, the mode ``strict`` deletes it."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from engine.metrics import panoptic
from engine.metrics.panoptic import MODES, FrameQuality, IdChanges, PanopticEvaluation, PanopticScores
from engine.scene import Category, ClassTable

THINGS = {4, 5, 6, 14, 15, 16, 17, 18, 20}
CLASSES = ClassTable(tuple(Category(i, f"class {i}", i in THINGS, (i, i, i)) for i in range(1, 22)))

# (predicted class, predicted id, true class, true id, pixels)
PERFECT = [(1, 0, 1, 0, 400), (2, 0, 2, 0, 300), (5, 7, 5, 1, 200), (5, 3, 5, 2, 100)]
SPLIT = [(1, 0, 1, 0, 400), (2, 0, 2, 0, 300), (5, 7, 5, 1, 120), (5, 8, 5, 1, 80), (5, 3, 5, 2, 100)]
SWAP = [(1, 0, 1, 0, 700), (5, 1, 5, 1, 100), (5, 2, 5, 2, 50), (5, 2, 5, 1, 100), (5, 1, 5, 2, 50)]
TRUE_VOID = [(1, 0, 1, 0, 500), (2, 0, 2, 0, 300), (5, 1, 0, 0, 200)]
VOID_10 = [(1, 0, 1, 0, 500), (2, 0, 2, 0, 400), (0, 0, 2, 0, 100)]
VOID_04 = [(1, 0, 1, 0, 500), (2, 0, 2, 0, 496), (0, 0, 2, 0, 4)]
RARE_SOFA = [(1, 0, 1, 0, 500), (2, 0, 2, 0, 400), (6, 1, 6, 1, 4), (5, 1, 6, 1, 96)]
NO_SOFA = [(1, 0, 1, 0, 500), (2, 0, 2, 0, 400), (5, 1, 6, 1, 100)]
HALLUCINATED = [(1, 0, 1, 0, 500), (2, 0, 2, 0, 400), (5, 1, 1, 0, 100)]
THING_ZERO = [(1, 0, 1, 0, 500), (5, 1, 5, 0, 200), (5, 2, 5, 3, 300)]
MERGED = [(1, 0, 1, 0, 700), (5, 1, 5, 1, 200), (5, 1, 5, 2, 100)]
CONFUSED = [(1, 0, 1, 0, 450), (2, 0, 1, 0, 50), (2, 0, 2, 0, 450), (1, 0, 2, 0, 50)]

PL_COMPAT = {
    "perfect": (PERFECT, 1, 1, 1, 1),
    "chair split 60/40": (SPLIT, 1, 0.88, 0.933333, 0.933333),
    "ids swap between views": (SWAP, 1, 0.5, 0.5, 0.5),
    "true void ignored": (TRUE_VOID, 1, 1, 1, 1),
    "10 % predicted void": (VOID_10, 0.6, 0.6, 0.6, 0.666667),
    "0.4 % predicted void": (VOID_04, 0.996, 1, 1, 1),
    "sofa 0.4 % predicted": (RARE_SOFA, 0.51, 0.666667, 0.666667, 0.666667),
    "sofa 0 % predicted": (NO_SOFA, 0.5, 0.5, 0.5, 0.5),
    "hallucinated class": (HALLUCINATED, 0.611111, 0.611111, 0.611111, 0.666667),
    "true thing with id 0": (THING_ZERO, 1, 1, 1, 1),
    "two chairs merged": (MERGED, 1, 0.722222, 0.833333, 0.833333),
    "10 % confusion": (CONFUSED, 0.818182, 0.818182, 0.818182, 1),
}
# By hand: where the two modes part, predicted void is a miss (not a class) and no class is dropped for being
# rare.
STRICT = PL_COMPAT | {
    "10 % predicted void": (VOID_10, 0.9, 0.9, 0.9, 1),
    "0.4 % predicted void": (VOID_04, 0.996, 0.996, 0.996, 1),
    "sofa 0.4 % predicted": (RARE_SOFA, 0.51, 0.5, 0.5, 0.5),
}

# By hand: the mean over the classes that the ground truth has, the same in both modes.
OVER_TRUE_CLASSES = {
    "perfect": 1.0,
    "chair split 60/40": 1.0,
    "ids swap between views": 1.0,
    "true void ignored": 1.0,
    "10 % predicted void": (1.0 + 400 / 500) / 2,
    "0.4 % predicted void": (1.0 + 496 / 500) / 2,
    "sofa 0.4 % predicted": (1.0 + 1.0 + 4 / 100) / 3,
    "sofa 0 % predicted": (1.0 + 1.0 + 0.0) / 3,
    "hallucinated class": (500 / 600 + 1.0) / 2,
    "true thing with id 0": 1.0,
    "two chairs merged": 1.0,
    "10 % confusion": 450 / 550,
}


def lay_out(rows: list[tuple[int, int, int, int, int]]) -> list[np.ndarray]:
    """The four maps of run-length rows as pictures of one line."""
    counts = [row[4] for row in rows]
    return [np.repeat([row[k] for row in rows], counts).astype(np.int32)[None, :] for k in range(4)]


@pytest.fixture
def unstretched(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oracle's data are run lengths: stretched to 512x512 they would keep their shares only roughly."""
    monkeypatch.setattr(panoptic, "resize_nearest", lambda values, size: values)


@pytest.mark.usefixtures("unstretched")
@pytest.mark.parametrize(("mode", "case"), [(m, c) for m in MODES for c in PL_COMPAT])
def test_panoptic_scores_match_the_published_evaluator(mode: str, case: str) -> None:
    rows, *expected = (PL_COMPAT if mode == "pl_compat" else STRICT)[case]
    evaluation = PanopticEvaluation(CLASSES, mode)
    evaluation.add(*lay_out(rows))
    scores = evaluation.result()
    assert (scores.miou, scores.pq, scores.sq, scores.rq) == pytest.approx(expected, abs=1e-6)
    assert scores.miou_true == pytest.approx(OVER_TRUE_CLASSES[case], abs=1e-6)
    assert scores.mode == mode


def test_the_mode_pl_compat_scales_every_label_map_to_512x512() -> None:
    evaluation = PanopticEvaluation(CLASSES, "pl_compat")
    predicted = np.array([[1, 1, 2, 2]] * 3)
    true = np.array([[1] * 5 + [2] * 5] * 7)
    evaluation.add(predicted, np.zeros_like(predicted), true, np.zeros_like(true))
    assert evaluation.result().miou == 1.0
    small = PanopticEvaluation(CLASSES, "pl_compat")
    for value, size in ((1, (300, 400)), (2, (3, 4))):  # a small view weighs as much as a large one
        label = np.full(size, value)
        small.add(np.full(size, 1), np.zeros(size, int), label, np.zeros(size, int))
    assert small.result().miou == pytest.approx(0.25)


def test_panoptic_evaluation_refuses_bad_label_maps() -> None:
    with pytest.raises(ValueError, match="unknown mode"):
        PanopticEvaluation(CLASSES, "lenient")  # type: ignore[arg-type]
    evaluation = PanopticEvaluation(CLASSES, "strict")
    with pytest.raises(ValueError, match="negative"):
        evaluation.add(*[np.full((2, 2), -1)] * 4)
    evaluation.add(*[np.zeros((2, 2), int)] * 4)
    with pytest.raises(ValueError, match="no pixel has ground truth"):
        evaluation.result()


def test_a_predicted_class_outside_the_table_counts_as_void() -> None:
    evaluation = PanopticEvaluation(CLASSES, "strict")
    evaluation.add(*lay_out([(1, 0, 1, 0, 10), (1, 0, 99, 5, 10), (98, 3, 1, 0, 10)]))
    scores = evaluation.result()
    assert scores.miou == pytest.approx(0.5)
    assert [row.class_id for row in scores.per_class] == [1]


a_class, an_id = st.sampled_from([0, 1, 2, 4, 5]), st.integers(0, 3)
labels = st.lists(st.tuples(a_class, an_id, a_class, an_id, st.integers(1, 40)), min_size=1, max_size=12)


@pytest.mark.parametrize("mode", MODES)
@given(rows=labels)
@settings(max_examples=25, deadline=None)
def test_panoptic_scores_lie_between_0_and_1(mode: str, rows: list[tuple[int, int, int, int, int]]) -> None:
    maps = lay_out([*rows, (1, 0, 1, 0, 5)])
    scores = _scores(mode, *maps)
    values = (scores.miou, scores.miou_true, scores.pq, scores.sq, scores.rq)
    assert scores.miou_true >= scores.miou - 1e-12
    assert all(0.0 <= value <= 1.0 for value in values)
    assert scores.pq <= min(scores.sq, scores.rq) + 1e-12
    # Ids are names: permuting them changes nothing.
    permuted = np.array([2, 7, 1, 12])[maps[1]]
    other = _scores(mode, maps[0], permuted, maps[2], maps[3])
    assert (other.miou, other.miou_true, other.pq, other.sq, other.rq) == pytest.approx(values)
    # The truth itself scores 1.
    perfect = _scores(mode, maps[2], maps[3], maps[2], maps[3])
    assert (perfect.miou, perfect.miou_true, perfect.pq, perfect.sq, perfect.rq) == (1.0,) * 5


def _scores(mode: str, *maps: np.ndarray) -> PanopticScores:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(panoptic, "resize_nearest", lambda values, size: values)
        evaluation = PanopticEvaluation(CLASSES, mode)  # type: ignore[arg-type]
        evaluation.add(*maps)
    return evaluation.result()


TWO_CLASSES = ClassTable((Category(1, "wall", False, (9, 9, 9)), Category(5, "chair", True, (200, 9, 9))))
TRUE_CLASS = np.array([[1, 1, 1, 5, 5, 5, 5, 5]], np.int32)
CHAIRS = np.array([[0, 0, 0, 1, 1, 2, 2, 2]], np.int32)


def scores_of(predicted_ids: list[list[int]]) -> tuple[FrameQuality, IdChanges]:
    """The scores of frames with the right classes and these ids."""
    quality, changes = FrameQuality(TWO_CLASSES), IdChanges(TWO_CLASSES)
    for ids in predicted_ids:
        maps = TRUE_CLASS, np.array([ids], np.int32), TRUE_CLASS, CHAIRS
        shared = PanopticEvaluation(TWO_CLASSES, "strict").add(*maps)
        quality.add(shared)
        changes.add(shared)
    return quality, changes


def test_changing_ids_between_frames_do_not_lower_per_frame_scores() -> None:
    quality, changes = scores_of([[0, 0, 0, 1, 1, 2, 2, 2], [0, 0, 0, 7, 7, 8, 8, 8], [0, 0, 0, 7, 7, 9, 9, 9]])
    assert quality.pq == 1.0
    assert changes.per_object == pytest.approx((1 + 2) / 2)


def test_two_objects_predicted_as_one_count_as_one_match() -> None:
    quality, changes = scores_of([[0, 0, 0, 1, 1, 2, 2, 2], [0, 0, 0, 2, 2, 2, 2, 2], [0, 0, 0, 1, 1, 2, 2, 2]])
    # Chairs: 5 found, one of them with IoU 3/5; the missed one is one error, the merged one none.
    assert quality.pq == pytest.approx((1 + 4.6 / (5 + 0.5)) / 2)
    assert changes.per_object == 0.0, "out of sight for a frame, and the same afterwards"


def test_panoptic_scores_without_frames_are_none() -> None:
    quality, changes = scores_of([])
    assert quality.pq is None and changes.per_object is None
    assert scores_of([[0, 0, 0, 1, 1, 2, 2, 2]])[1].per_object is None, "seen once"


OBJECTS, STUFF = (2, 5), (1, 3, 4)
RANDOM_CLASSES = ClassTable(tuple(Category(i, f"class {i}", i in OBJECTS, (i, i, i)) for i in sorted(OBJECTS + STUFF)))
PICTURE = (24, 32)

Maps = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]


def random_views(seed: int, frames: int) -> list[Maps]:
    """True labels in blocks, and predictions that differ by noise, other classes and other ids."""
    random = np.random.default_rng(seed)
    views = []
    for _ in range(frames):
        rows, columns = np.indices(PICTURE)
        block = (rows // 8) * 4 + columns // 8
        kind, number = random.choice(RANDOM_CLASSES.ids, 12), random.integers(0, 4, 12)
        guess = np.where(random.random(12) < 0.25, random.choice(RANDOM_CLASSES.ids, 12), kind)
        name = np.where(random.random(12) < 0.25, random.integers(0, 4, 12), number)
        astray = random.random(PICTURE) < random.choice([0.0, 0.2, 0.5])
        moved = np.where(astray, random.integers(0, 12, PICTURE), block)
        maps = [kind[block], number[block], guess[moved], name[moved]]
        for classes, ids in ((maps[0], maps[1]), (maps[2], maps[3])):
            ids[~np.isin(classes, OBJECTS)] = 0
        true_class, true_id, classes, ids = (each.astype(np.int32) for each in maps)
        views.append((classes, ids, true_class, true_id))
    return views


def panoptic_quality(pairs: list[tuple[NDArray[np.int32], NDArray[np.int32]]]) -> float:
    """PQ by torchmetrics, of predicted and true (class, instance) pictures [H, W, 2]."""
    from torchmetrics.detection import PanopticQuality  # takes seconds to import

    metric = PanopticQuality(set(OBJECTS), set(STUFF), allow_unknown_preds_category=True)
    for predicted, true in pairs:
        metric.update(torch.from_numpy(predicted)[None], torch.from_numpy(true)[None])
    return float(metric.compute())


@pytest.mark.parametrize("seed", range(12))
def test_panoptic_scores_of_random_labels_match_torchmetrics(seed: int) -> None:
    from torchmetrics.classification import MulticlassJaccardIndex

    views = random_views(seed, frames=1 + seed % 4)
    scene, frames = PanopticEvaluation(RANDOM_CLASSES, "strict"), FrameQuality(RANDOM_CLASSES)
    for view in views:
        frames.add(scene.add(*view))
    pairs = [(np.stack(view[:2], axis=-1), np.stack(view[2:], axis=-1)) for view in views]
    whole = [(np.concatenate([p for p, _ in pairs]), np.concatenate([t for _, t in pairs]))]
    scores = scene.result()
    assert scores.pq == pytest.approx(panoptic_quality(whole), abs=1e-6)
    assert frames.pq == pytest.approx(panoptic_quality(pairs), abs=1e-6)
    classes, true = (torch.from_numpy(each[..., 0]).long() for each in whole[0])
    jaccard = MulticlassJaccardIndex(num_classes=max(RANDOM_CLASSES.ids) + 1)
    assert scores.miou == pytest.approx(float(jaccard(classes, true)), abs=1e-6)
