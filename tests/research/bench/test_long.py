"""The benchmark of long captures: what it tells of each stage."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from engine.errors import PlgsError
from engine.job.prediction import Prediction
from research.bench import long
from research.bench.long import LongLift, Sample, StageCost, facts, print_table, samples_of, stage_costs

MB = 1_000_000
USUAL = Prediction({"start": 4.0, "train": 5.0, "result": 1.0}, 640 * MB)


def test_a_stage_has_its_own_time_and_its_own_peak() -> None:
    stages = [(10.0, "check"), (13.0, "train")]
    looks = [(8.0, 5, 1.0), (9.9, 7, 2.0), (10.5, 20, 2.5), (12.9, 30, 6.0), (13.1, 12, 6.0), (19.0, 11, 13.0)]
    samples = [Sample(*look) for look in looks]
    costs = stage_costs(stages, 7.0, 20.0, samples)
    assert costs == {
        "start": StageCost(3.0, 2.0, 7),
        "check": StageCost(3.0, 4.0, 30),
        "train": StageCost(7.0, 7.0, 12),
    }
    lift = LongLift(100, costs, 0.5, 0.25, USUAL)
    assert lift.seconds == 13.0 and lift.busy == 13.0 and lift.peak_bytes == 30
    assert json.loads(json.dumps(facts(lift)))["stages"]["check"] == {"seconds": 3.0, "busy": 4.0, "peak_bytes": 30}


def test_the_time_per_frame_is_compared_with_the_first(capsys: pytest.CaptureFixture[str]) -> None:
    costs = {"check": StageCost(2.0, 4.0, 300 * MB), "train": StageCost(8.0, 6.0, 500 * MB)}
    more = {"check": StageCost(6.0, 9.0, 400 * MB), "train": StageCost(9.0, 12.0, 700 * MB)}
    print_table([LongLift(100, costs, 0.7, 0.6, USUAL), LongLift(300, more, 0.71, 0.65, USUAL)])
    printed = capsys.readouterr().out
    assert "a frame of 300 takes 0.50 times that of 100, and keeps processors busy 0.70 times as long" in printed
    assert "15.0 s      21.0 s     700 MB" in printed and "70.0 / 60.0" in printed and "71.0 / 65.0" in printed
    # Of 10 s a usual machine trains 5; this one trained 8 and 9.
    assert "predicted              16.0 s                   640 MB         18.0 s" in printed


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="a process's memory is looked up in /proc")
def test_memory_is_that_of_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import sys; held = bytearray(200_000_000); print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        ours, theirs = process.stdin, process.stdout
        assert ours is not None and theirs is not None and theirs.readline()
        monkeypatch.setattr(long, "time", SimpleNamespace(time=time.time, sleep=lambda seconds: ours.close()))
        samples = samples_of(process)
    assert max(sample.held for sample in samples) > 200 * MB and samples[-1].busy >= samples[0].busy


def test_without_the_sample_there_is_no_long_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long, "CAPTURE_PROGRAM", tmp_path / "none.py")
    with pytest.raises(PlgsError, match="nothing to make"):
        long.bench_long([10], tmp_path)
