"""A batch's simulated scheduler, and the arithmetic that the documentation gives beside it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from research.bench.farm import BatchTimes, expected_s, simulated_s

TIMES = BatchTimes(lift_s=100.0, bake_s=10.0, bakes=4, score_s=5.0, overhead_s=1.0)


def test_one_worker_does_one_piece_after_the_other() -> None:
    assert simulated_s(TIMES, 3, 1) == pytest.approx(3 * TIMES.work_s) == pytest.approx(3 * (100 + 40 + 5 + 6))


def test_one_scene_is_never_faster_than_its_longest_path() -> None:
    assert simulated_s(TIMES, 1, 50) == TIMES.longest_s == 100 + 1 + 10 + 1 + 5 + 1
    assert simulated_s(replace(TIMES, bakes=0), 1, 50) == 100 + 1 + 5 + 1


@pytest.mark.parametrize("workers", [2, 10, 100])
def test_the_arithmetic_is_close_for_many_scenes(workers: int) -> None:
    simulated, expected = simulated_s(TIMES, 1000, workers), expected_s(TIMES, 1000, workers)
    assert expected <= simulated < expected + TIMES.work_s
