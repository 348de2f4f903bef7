"""The live line, and the signals around a lift."""

import io
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from engine.job.report import metrics_text, not_shown
from engine.job.task import TaskProgress
from engine.job.terminal import Interrupted, Interrupts, LiveLine, ask_engine, describe
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene

TRAINING = TaskProgress("train", "Training", 2, 3, step=5, steps=10, loss=0.25, eta_s=61.0)


class Terminal(io.StringIO):
    """A stream that a person looks at."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("progress", "text"),
    [
        (TaskProgress(), "Starting"),
        (TaskProgress("train", "Training", 2, 3), "[2/3] Training"),
        (TRAINING, "[2/3] Training  5/10  loss 0.2500  1:01 left"),
        (TaskProgress("bake", "Baking", 3, 3, step=1, steps=9, eta_s=3725.2), "[3/3] Baking  1/9  1:02:05 left"),
        (replace(TRAINING, left_s=90.4), "[2/3] Training  5/10  loss 0.2500  1:01 left  1:30 to the end"),
    ],
)
def test_progress_is_described_in_one_line(progress: TaskProgress, text: str) -> None:
    assert describe(progress) == text


def test_progress_in_a_terminal_is_one_line_that_changes() -> None:
    line = LiveLine(stream := Terminal())
    line.show(TaskProgress("train", "Training with a long label", 1, 2))
    line.show(TRAINING)
    line.show(TRAINING)
    line.say("warning: dark")
    line.show(TRAINING)
    line.end()
    assert stream.getvalue().count("\n") == 2
    said = [part.strip() for part in stream.getvalue().split("\r")[1:]]
    assert said == ["[1/2] Training with a long label", describe(TRAINING), "", "warning: dark", describe(TRAINING)]


def test_progress_written_to_a_file_is_few_whole_lines() -> None:
    line = LiveLine(stream := io.StringIO())
    line.show(TaskProgress())
    for step in range(1000):
        line.show(TaskProgress("train", "Training", 1, 2, step=step, steps=1000))
    line.show(TaskProgress("bake", "Baking", 2, 2))
    line.end()
    said = stream.getvalue().splitlines()
    assert said == ["Starting", "[1/2] Training  0/1000", "[1/2] Training  999/1000", "[2/2] Baking"]


@contextmanager
def handled(number: signal.Signals, handler: Any) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def test_a_signal_waits_until_protected_code_has_ended() -> None:
    steps = []
    with handled(signal.SIGTERM, signal.SIG_DFL):
        with pytest.raises(Interrupted) as caught, Interrupts() as interrupts, interrupts.deferred():
            os.kill(os.getpid(), signal.SIGTERM)
            steps.append(interrupts.pending)
    assert steps == [signal.SIGTERM] and caught.value.exit_code == 143


def test_a_signal_during_an_import_counts_as_an_interruption() -> None:
    with handled(signal.SIGINT, signal.default_int_handler):
        with pytest.raises(Interrupted) as caught, Interrupts():
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except Interrupted:
                raise ImportError("numpy cannot be imported") from None
        assert caught.value.exit_code == 130
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        with pytest.raises(ImportError), Interrupts():
            raise ImportError


def test_a_signal_that_was_ignored_stays_ignored() -> None:
    with handled(signal.SIGHUP, signal.SIG_IGN), Interrupts():
        os.kill(os.getpid(), signal.SIGHUP)


def test_impossible_numbers_in_metrics_are_shown_as_a_dash() -> None:
    """JSON's integers have no end: one of them ended the engine and Blender's script with a traceback."""
    for number in (10**400, -(10**400), 1e308, float("nan"), float("inf"), "7", None, []):
        table = {"name": "lifted", "mode": "strict", "miou": number, "psnr": number, "pq": 0.5}
        table["per_class"] = [{"name": "wall", "iou": number, "tp": number, "fp": 3}]
        lines = metrics_text({"tables": [table]}, per_class=True).splitlines()
        assert lines[1].split() == ["lifted", "strict", "-", "-", "50.0", *"-" * 8]
        assert lines[-1].split() == ["wall", "-", "-", "-", "-", "-", "3", "-"]


def test_objects_that_a_lift_does_not_show_are_reported() -> None:
    sink = {"name": "sink", "whole_class": True, "views": 4, "shown_as": "countertop", "frame": "0012"}
    chair = {"name": "chair", "whole_class": False, "views": 3, "shown_as": "", "frame": "0031"}
    metrics = {"tables": [{"name": "lifted"}], "masks_as_judges": {"not_shown": [sink, chair, "no entry"]}}
    assert not_shown(metrics) == [
        ("sink: seen from near in 4 views, shown as countertop", "0012"),
        ("one chair: seen from near in 3 views", "0031"),
    ]
    assert metrics_text(metrics).splitlines()[-2:] == [
        "Not shown: sink: seen from near in 4 views, shown as countertop (see frame 0012)",
        "Not shown: one chair: seen from near in 3 views (see frame 0031)",
    ]
    judges = {"not_shown": [chair, sink, chair | {"views": 12, "frame": "0040"}, chair | {"shown_as": "wall"}]}
    assert len(not_shown({"masks_as_judges": judges})) == 4, "each row of the panel leads to a frame"
    assert not_shown({"masks_as_judges": judges}, together=True) == [
        ("2 objects of chair: seen from near in 3 to 12 views", "0031"),
        ("sink: seen from near in 4 views, shown as countertop", "0012"),
        ("one chair: seen from near in 3 views, shown as wall", "0031"),
    ]
    for broken in ({}, {"masks_as_judges": 3}, {"masks_as_judges": {"not_shown": 7}}):
        assert not_shown(broken) == []


def test_an_engine_finds_a_scene_that_is_named_from_the_folder_of_the_terminal(
    tmp_path: Path, quick_python: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_tiny_scene(tmp_path / "room", frames=3)
    monkeypatch.chdir(tmp_path)
    with Interrupts() as interrupts, raises_key(f"has-poses {tmp_path}"):
        ask_engine(quick_python, interrupts, "poses", Path("room"))
