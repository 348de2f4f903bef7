"""``python -m research bench long``: what a long capture takes, stage by stage: seconds and peak memory.

The captures are made by the program ``sample/long_capture.py`` out of the bundled sample, and kept. Each is lifted in a
process of its own, as a user's would be. Its memory is what the system says it holds, sampled many times a second; the
stages are those of its events.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from engine.errors import PlgsError
from engine.job import LiftFolder, LiftRequest
from engine.job.events import last_run
from engine.job.prediction import Prediction
from engine.job.request import PresetName
from engine.lift.fitting import masks_a_frame, predicted_lift
from engine.metrics.report import LIFTED
from engine.scene import open_scene

from .raster import processor_name

REPOSITORY = Path(__file__).resolve().parents[2]
CAPTURE_PROGRAM = REPOSITORY / "sample" / "long_capture.py"
LOOK_EVERY_S = 0.05
MB = 1_000_000


@dataclass(frozen=True)
class StageCost:
    """``seconds`` of a stage, those that processors worked on it (in total: two cores give two per second; other
    programs do not count), and the most main memory that the process held in it."""

    seconds: float
    busy: float
    peak_bytes: int


class Sample(NamedTuple):
    """When (Unix seconds) a process was sampled, the bytes of main memory it held, and how many seconds processors
    had worked on it by then."""

    time: float
    held: int
    busy: float


@dataclass(frozen=True)
class LongLift:
    """A lift of ``frames`` frames: the cost of each stage, "start" first, in their order, how good it is on the frames
    held out (mIoU and PQ over the scene, in [0, 1]), and what was ``predicted`` for a typical machine."""

    frames: int
    stages: dict[str, StageCost]
    miou: float
    pq: float
    predicted: Prediction

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages.values())

    @property
    def busy(self) -> float:
        return sum(stage.busy for stage in self.stages.values())

    @property
    def peak_bytes(self) -> int:
        return max(stage.peak_bytes for stage in self.stages.values())

    @property
    def predicted_seconds(self) -> float:
        """At the pace of this machine, as its training steps show it, which a lift remembers for the next one."""
        return self.predicted.seconds * self.stages["train"].seconds / self.predicted.stages["train"]


def bench_long(frames: Sequence[int], folder: Path, preset: PresetName = "preview") -> list[dict[str, object]]:
    """Lift a capture of each number of ``frames``, print and return what it took. Captures lie in ``folder``.

    Raises PlgsError if the sample is missing, memory cannot be measured, or a lift fails.
    """
    if not CAPTURE_PROGRAM.exists():
        fix = "Run this in a clone of the repository: the extension comes without the sample."
        raise PlgsError("there is nothing to make a long capture from", CAPTURE_PROGRAM, fix)
    if not Path("/proc/self/status").exists():
        raise PlgsError("a process's memory cannot be measured here", sys.platform, "Run this on Linux.")
    print(f"{processor_name()}; preset {preset}", flush=True)
    lifts = []
    for count in frames:
        scene = long_capture(count, folder)
        with TemporaryDirectory(dir=folder) as place:
            request = LiftRequest(scene=scene.resolve(), preset=preset, bake="none")
            lifts.append(measured_lift(request, Path(place) / "lift", count))
        print_table(lifts)
    return [facts(lift) for lift in lifts]


def long_capture(frames: int, folder: Path) -> Path:
    """The capture of that many frames in ``folder``; it is made if it is not there. Raises PlgsError."""
    scene = folder / f"capture-{frames}"
    if not scene.exists():
        folder.mkdir(parents=True, exist_ok=True)
        print(f"making a capture of {frames} frames ...", flush=True)
        made = subprocess.run([sys.executable, str(CAPTURE_PROGRAM), str(scene), "--frames", str(frames)], check=False)
        if made.returncode:
            raise PlgsError("the capture could not be made", scene, "See the output above.")
    return scene


def measured_lift(request: LiftRequest, out: Path, frames: int) -> LongLift:
    """Do the lift ``request`` in ``out``, in a process of its own, and watch. Raises PlgsError when it fails."""
    lift = LiftFolder.create(out, request)
    began = time.time()
    command = [sys.executable, "-m", "engine", "lift", str(lift.path)]
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL) as process:
        samples = samples_of(process)
    if process.returncode:
        raise PlgsError(f"the lift failed (exit code {process.returncode})", out, "See the output above.")
    stages = [(event.time, str(event.data["name"])) for event in last_run(lift.events_path) if event.kind == "stage"]
    costs = stage_costs(stages, began, time.time(), samples)
    tables = json.loads((lift.result_path / "metrics.json").read_text(encoding="utf-8"))["tables"]
    scores = next(table for table in tables if (table["name"], table["mode"]) == (LIFTED, "strict"))
    scene = open_scene(request.scene)
    predicted = predicted_lift(scene, request.chosen_preset, masks_a_frame(scene), request.bake)
    return LongLift(frames, costs, scores["miou"], scores["pq"], predicted)


def samples_of(process: subprocess.Popen[bytes]) -> list[Sample]:
    """Samples of a process until it ends."""
    folder = Path(f"/proc/{process.pid}")
    ticks = os.sysconf("SC_CLK_TCK")
    samples = []
    while process.poll() is None:
        held = [line for line in (folder / "status").read_text().splitlines() if line.startswith("VmRSS:")]
        if held:  # a process that has ended but was not waited for holds nothing
            fields = (folder / "stat").read_text().rpartition(")")[2].split()  # its name may have spaces
            busy = (int(fields[11]) + int(fields[12])) / ticks
            samples.append(Sample(time.time(), 1024 * int(held[0].split()[1]), busy))
        time.sleep(LOOK_EVERY_S)
    return samples


def stage_costs(
    stages: Sequence[tuple[float, str]], began: float, ended: float, samples: Sequence[Sample]
) -> dict[str, StageCost]:
    """The cost of each stage. ``stages``: when they begin (Unix seconds) and their names; before the first is
    "start"."""
    starts = [(began, "start"), *stages, (ended, "")]
    costs: dict[str, StageCost] = {}
    done = 0.0
    for (start, name), (end, _) in itertools.pairwise(starts):
        own = [sample for sample in samples if start <= sample.time < end]
        worked = own[-1].busy - done if own else 0.0
        costs[name] = StageCost(end - start, worked, max((sample.held for sample in own), default=0))
        done += worked
    return costs


def print_table(lifts: Sequence[LongLift]) -> None:
    """A column for each lift, with what was predicted; the time per frame is compared with that of the first."""
    names = list(dict.fromkeys(name for lift in lifts for name in lift.stages))
    print("".join(["stage".ljust(14), *(f"{lift.frames:>13} frames: time, busy, peak" for lift in lifts)]))
    for name in [*names, "all"]:
        cells = []
        for lift in lifts:
            whole = StageCost(lift.seconds, lift.busy, lift.peak_bytes)
            cost = whole if name == "all" else lift.stages.get(name, StageCost(0.0, 0.0, 0))
            cells.append(f"{cost.seconds:13.1f} s {cost.busy:9.1f} s {cost.peak_bytes / MB:7.0f} MB")
        print("".join([name.ljust(14), *cells]))
    foretold = [f"{lift.predicted_seconds:13.1f} s {lift.predicted.peak_bytes / MB:21.0f} MB" for lift in lifts]
    print("".join(["predicted".ljust(14), *foretold]))
    scores = [f"{100 * lift.miou:.1f} / {100 * lift.pq:.1f}".rjust(38) for lift in lifts]
    print("".join(["mIoU / PQ, %".ljust(14), *scores]))
    first = lifts[0]
    for lift in lifts[1:]:
        time_ratio, busy_ratio = (
            own / lift.frames / (other / first.frames)
            for own, other in ((lift.seconds, first.seconds), (lift.busy, first.busy))
        )
        print(
            f"a frame of {lift.frames} takes {time_ratio:.2f} times that of {first.frames}, and keeps processors busy "
            f"{busy_ratio:.2f} times as long (at most 1)"
        )
    print(flush=True)


def facts(lift: LongLift) -> dict[str, object]:
    """For JSON."""
    totals = {"seconds": lift.seconds, "busy": lift.busy, "peak_bytes": lift.peak_bytes}
    return {**asdict(lift), **totals, "predicted_seconds": lift.predicted_seconds}
