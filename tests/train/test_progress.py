"""The time that is left of a whole run."""

from __future__ import annotations

import pytest

from engine.train.progress import Course

PREDICTED = {"read": 10.0, "match": 20.0, "train": 60.0, "bake": 10.0}
FORESEEN = (0.5, 12.7, 5.6, 6.7, 192.8, 44.5, 5.7, 2.6)
STAGES = ("read", "consistency", "match", "prepare", "train", "result", "bake", "evaluate")
LIFT = (
    (17.6, "match", 0.01, None), (33.9, "train", 0.001, None), (48.7, "train", 0.09, 151.4),
    (62.8, "train", 0.183, 129.7), (91.0, "train", 0.361, 101.3), (119.3, "train", 0.547, 71.0),
    (147.8, "train", 0.75, 37.9), (176.3, "train", 0.948, 7.8), (190.4, "result", 0.181, 28.5),
    (204.5, "result", 0.695, 8.9), (218.9, "evaluate", 0.015, None),
)  # fmt: skip
"""Of the events of a lift that took 225.0 s after the check, the second floor with `standard`: seconds since then,
stage, share of it, seconds left of it. FORESEEN: what was predicted for STAGES."""


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


@pytest.mark.parametrize("slowness", [0.7, 1.0, 2.0])
def test_the_time_left_of_a_recorded_lift_is_steady(slowness: float) -> None:
    course = Course({name: slowness * seconds for name, seconds in zip(STAGES, FORESEEN, strict=True)})
    ends = []
    for at, name, share, eta in LIFT:
        left = course.left(name, share, eta, course.began + at)
        assert left is not None
        ends.append(at + left)
    assert ends[LIFT.index((91.0, "train", 0.361, 101.3)) :] == pytest.approx([225.0] * 7, rel=0.25)
    jumps = [abs(after - before) for before, after in zip(ends, ends[1:], strict=False)]
    assert max(jumps) < 0.5 * 225.0


def test_a_resumed_lift_does_not_mistake_skipped_steps_for_a_fast_pace() -> None:
    course = Course(PREDICTED)
    now = course.began + 30.0
    course.skip("train", 0.5)
    assert course.left("train", 0.5, None, now) == pytest.approx(40.0)
