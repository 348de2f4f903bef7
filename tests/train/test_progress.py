"""The time that is left of a whole run."""

from __future__ import annotations

import pytest

from engine.train.progress import Course

PREDICTED = {"read": 10.0, "match": 20.0, "train": 60.0, "bake": 10.0}


@pytest.mark.parametrize("slowness", [0.5, 1.0, 3.0])
def test_the_time_left_follows_the_measured_pace(slowness: float) -> None:
    course = Course(PREDICTED)
    total, passed = slowness * 100.0, 0.0
    for name, seconds in PREDICTED.items():
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            gone = passed + slowness * share * seconds
            eta = None if share == 0.0 else slowness * (1.0 - share) * seconds
            left = course.left(name, share, eta, course.began + gone)
            assert left is not None and left >= 0.0
            if gone > 0.3 * total:  # a prediction that is off by three has been corrected by then
                assert left == pytest.approx(total - gone, abs=0.2 * total)
        passed += slowness * seconds
    assert left == 0.0


def test_a_stage_that_was_not_predicted_has_no_time_left() -> None:
    course = Course(PREDICTED)
    assert course.left("check", 0.5, 1.0, course.began + 1.0) is None
