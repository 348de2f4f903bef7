"""What a batch takes on many workers: the times of its pieces, as measured, dealt out by a simulated scheduler."""

from __future__ import annotations

import heapq
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class BatchTimes:
    """Seconds of one scene's lift, of each of its ``bakes``, and of its score; ``overhead_s`` is what each piece takes
    in addition, until the next one begins."""

    lift_s: float
    bake_s: float
    bakes: int
    score_s: float
    overhead_s: float

    @property
    def work_s(self) -> float:
        """All of one scene, one piece after the other."""
        pieces = 2 + self.bakes
        return self.lift_s + self.bakes * self.bake_s + self.score_s + pieces * self.overhead_s

    @property
    def longest_s(self) -> float:
        """One scene on as many workers as it can use."""
        bake_s = self.bake_s + self.overhead_s if self.bakes else 0.0
        return self.lift_s + self.score_s + 2 * self.overhead_s + bake_s


def expected_s(times: BatchTimes, scenes: int, workers: int) -> float:
    """By arithmetic: all work shared evenly, and nothing is faster than one scene."""
    return max(scenes * times.work_s / workers, times.longest_s)


def simulated_s(times: BatchTimes, scenes: int, workers: int) -> float:
    """A free worker takes the next piece: scenes that were begun come before those that were not."""
    now, free = 0.0, workers
    ready = [(0, scene, "lift") for scene in range(scenes)]
    running: list[tuple[float, int, str]] = []
    left = dict.fromkeys(range(scenes), times.bakes)
    seconds = {"lift": times.lift_s, "bake": times.bake_s, "score": times.score_s}
    while ready or running:
        while ready and free:
            _, scene, kind = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[kind] + times.overhead_s, scene, kind))
            free -= 1
        now, scene, kind = heapq.heappop(running)
        free += 1
        if kind == "lift":
            for _ in range(times.bakes):
                heapq.heappush(ready, (-1, scene, "bake"))
        left[scene] -= kind == "bake"
        if kind != "score" and not left[scene]:
            heapq.heappush(ready, (-2, scene, "score"))
    return now


def bench_farm(times: BatchTimes, scenes: int, workers: tuple[int, ...] = (1, 2, 10, 100)) -> dict[str, object]:
    """Print and return what this many scenes take, by arithmetic and as simulated."""
    print(f"{scenes} scenes; one takes {times.work_s:.0f} s of work, {times.longest_s:.0f} s at least")
    rows = []
    for number in workers:
        expected, simulated = expected_s(times, scenes, number), simulated_s(times, scenes, number)
        rows.append({"workers": number, "expected_s": expected, "simulated_s": simulated})
        speed_up = scenes * times.work_s / simulated
        print(
            f"{number:5d} workers: {expected / 60:8.1f} min expected, {simulated / 60:8.1f} simulated, {speed_up:5.1f}x"
        )
    return {"times": asdict(times), "scenes": scenes, "rows": rows}
