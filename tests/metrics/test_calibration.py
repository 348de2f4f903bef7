"""From shares to probabilities, by masks alone."""

from dataclasses import replace

import numpy as np
import pytest

from engine.metrics.calibration import UNCALIBRATED, Calibration, Samples, calibrate, fitted, samples_of
from engine.scene import Camera, PanopticMask, Segment, View

SIZE = (40, 30)
WALL, CHAIR, SOFA = 1, 2, 3


def view(ids: np.ndarray, score: float) -> View:
    """A wall at 2 m with a mask of these class ids [30, 40]."""
    camera = Camera(*SIZE, 30.0, 30.0, 20.0, 15.0, np.eye(4))
    segments = tuple(Segment(one, one, one != WALL, score) for one in (WALL, CHAIR, SOFA) if (ids == one).any())
    depth = np.full(SIZE[::-1], 2.0, np.float32)
    mask = PanopticMask(ids.astype(np.int32), segments)
    return View("0", camera, np.zeros((*depth.shape, 3), np.uint8), depth, mask)


def noisy_views(count: int, score: float, wrong: float) -> list[View]:
    """Views of a wall whose masks call each pixel a chair or a sofa with this probability, independently."""
    rng = np.random.default_rng(7)
    draws = (np.where(rng.random(SIZE[::-1]) < wrong, rng.integers(2, 4, SIZE[::-1]), WALL) for _ in range(count))
    return [view(ids, score) for ids in draws]


def shown(right: float, low: float = 0.6) -> Samples:
    """Pixels of the wall: the left half shows it with share ``low``, and is right in ``right`` of the cases; the rest
    is certain."""
    rng = np.random.default_rng(3)
    left = np.arange(SIZE[0])[None] < SIZE[0] // 2
    is_wrong = left & (rng.random(SIZE[::-1]) >= right)
    share = np.where(left, low, 1.0) * np.ones(SIZE[::-1])
    classes = np.where(is_wrong, CHAIR, WALL).astype(np.int32)
    return samples_of(view(np.full(SIZE[::-1], WALL), 1.0), classes, share.astype(np.float32), 10_000)


def test_many_unreliable_masks_are_calibrated_together() -> None:
    views = noisy_views(15, score=0.7, wrong=0.3)
    found = calibrate(shown(right=0.8), views[3:], views[:3])
    sure, unsure = found(np.array([1.0, 0.6], np.float32)).tolist()
    assert unsure == pytest.approx(0.8, abs=0.04) and sure == pytest.approx(1.0, abs=0.03)
    assert found.factor == pytest.approx(1.0, abs=0.03)
    assert found.samples == 1200


@pytest.mark.parametrize("held_back", [3, 0])
def test_confidence_is_lowered_to_the_scores_of_the_masks(held_back: int) -> None:
    views = noisy_views(15, score=0.6, wrong=0.0)
    found = calibrate(shown(right=1.0), views[held_back:], views[:held_back])
    assert found.factor == pytest.approx(0.6) and set(found.right) == {0.0, 0.6}
    assert calibrate(shown(right=1.0), noisy_views(15, 1.0, 0.0), []).factor == 1, "without scores they are believed"


def test_confidence_is_scaled_by_the_reliability_of_held_out_masks() -> None:
    trusted, doubtful = noisy_views(8, 1.0, 0.0), noisy_views(2, 0.5, 0.0)
    assert calibrate(shown(right=1.0), trusted, doubtful).factor == pytest.approx(0.5)


def test_too_few_judged_points_leave_confidence_uncalibrated() -> None:
    share = np.array([0.0, 0.3, 1.0], np.float32)
    few = Samples(*(each[:100] for each in shown(right=1.0)))
    behind = [replace(one, depth=one.depth - 1) for one in noisy_views(5, 0.5, 0.0)]
    for found in (calibrate(few, noisy_views(5, 0.5, 0.0), []), calibrate(shown(1.0), behind, []), UNCALIBRATED):
        assert found == UNCALIBRATED and (found(share) == share).all()


def test_the_calibration_curve_is_monotone_and_unbiased() -> None:
    rng = np.random.default_rng(0)
    share = rng.random(5000)
    right = rng.random(5000) < share**2
    shares, probability = fitted(share, right)
    assert (np.diff(probability) >= 0).all() and (np.diff(shares) > 0).all()
    assert np.abs(np.array(probability) - np.array(shares) ** 2).max() < 0.08
    assert np.interp(share, shares, probability).mean() == pytest.approx(right.mean(), abs=0.01)
    assert fitted(np.ones(300), right[:300]) == ((0.0, 1.0), (0.0, pytest.approx(right[:300].mean(), abs=1e-5)))


@pytest.mark.parametrize(
    ("share", "right"), [((0.2, 0.1), (0.1, 0.2)), ((0.1, 0.2), (0.2, 0.1)), ((0.1,), (1.5,)), ((0.1,), ()),
                         ((float("nan"),), (0.5,)), (("x",), (0.5,))],
)  # fmt: skip
def test_an_impossible_calibration_is_refused(share: tuple[float, ...], right: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="."):
        Calibration(share, right)


def test_a_calibrated_share_of_zero_stays_zero() -> None:
    half = Calibration((0.0, 1.0), (0.5, 0.5))
    assert half(np.array([0.0, 0.2, 1.0], np.float32)).tolist() == [0.0, 0.5, 0.5]
    half_right, none = shown(right=1.0, low=0.5), Samples(*(each[:0] for each in shown(right=1.0)))
    assert [half.doubt(half_right), UNCALIBRATED.doubt(half_right), half.doubt(none)] == pytest.approx([0.5, 0.25, 0])
