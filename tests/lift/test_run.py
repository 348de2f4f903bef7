"""Which states of a trainer are stored, what a run reports, and the time that is left of it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.errors import Cancelled, PlgsError
from engine.job import Checkpoint, EventReader, EventWriter, LiftFolder, LiftRequest, StopSignal
from engine.job import progress as job_progress
from engine.job.progress import Course, StageReporter
from engine.lift import run
from engine.plates import make_fills
from engine.presets.preset import PRESETS
from engine.scene import PanopticMask, Segment, load_view, open_scene
from engine.train.trainer import StepReport
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import warnings_in


class Trainer:
    """Changes its state at the beginning of a step, and fails in the middle of the third as it is told to."""

    preset = type("Preset", (), {"last_step": 5})

    def __init__(self, failure: Exception | None) -> None:
        self.failure, self.step_number, self.stored, self.scene = failure, 0, -1, None

    @property
    def finished(self) -> bool:
        return self.step_number >= 5

    def step(self, check: object) -> StepReport:
        if self.step_number == 2 and isinstance(self.failure, Cancelled):
            raise self.failure
        self.step_number += 1
        if self.step_number == 3 and self.failure is not None:
            raise self.failure
        return StepReport(self.step_number, 1.0, 1.0, 0.0, 0.0, 1)


@pytest.fixture
def stages(tmp_path: Path) -> Iterator[StageReporter]:
    events = EventWriter(tmp_path / "events.jsonl")
    yield StageReporter(events, StopSignal(tmp_path / "cancel"), run.STAGES)
    events.close()


@pytest.mark.parametrize(
    ("failure", "every_s", "stored"),
    [
        (None, 1e9, 5),  # at the end
        (Cancelled("asked to"), 1e9, 2),  # when stopped
        (MemoryError(), -1.0, 2),  # now and then, and never half a step
        (MemoryError(), 1e9, -1),
    ],
)
def test_a_checkpoint_is_never_written_in_the_middle_of_a_step(
    failure: Exception | None, every_s: float, stored: int, stages: StageReporter, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(run, "CHECKPOINT_EVERY_S", every_s)
    monkeypatch.setattr(run, "CHECKPOINT_SHARE", float("inf"))
    monkeypatch.setattr(run, "save_checkpoint", lambda trainer, *_: setattr(trainer, "stored", trainer.step_number))
    trainer, folder = Trainer(failure), LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    if failure is None:
        run.train(trainer, folder, [], stages, show=lambda scene: None)  # type: ignore[arg-type]
    else:
        with pytest.raises(type(failure)):
            run.train(trainer, folder, [], stages, show=lambda scene: None)  # type: ignore[arg-type]
    assert trainer.stored == stored


@pytest.mark.parametrize(("seconds", "saves"), [(0.1, 250), (4.0, 24)])
def test_writing_checkpoints_takes_at_most_two_percent_of_the_time(
    seconds: float, saves: int, stages: StageReporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, stored = [0.0], []
    clock = type("Clock", (), {"monotonic": lambda: now[0]})

    def save(*_: object) -> None:
        now[0] += seconds
        stored.append(now[0])

    monkeypatch.setattr(run, "time", clock)
    monkeypatch.setattr(run, "save_checkpoint", save)
    trainer = Trainer(None)
    monkeypatch.setattr(Trainer, "finished", property(lambda self: now[0] >= 5000))
    monkeypatch.setattr(trainer.preset, "last_step", 10**6)
    stages.course = None
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    run.train(trainer, folder, {}, stages, show=lambda scene: now.append(now.pop() + 0.5))  # type: ignore[arg-type]
    assert saves - 8 <= len(stored) <= saves + 2 and seconds * len(stored) <= 0.021 * now[0]


@pytest.mark.parametrize(("depth", "label", "told"), [(0.0, 1, "no-depth-left"), (1.0, 0, "no-masks-left")])
def test_masks_or_depth_lost_at_training_size_are_refused(depth: float, label: int, told: str, tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "scene", frames=2))
    view = load_view(scene.train_frames[0], (4, 3))
    run.refuse_empty([view], scene)
    ids = np.full((3, 4), label, np.int32)
    mask = PanopticMask(ids, (Segment(1, 1, False),))
    bad = replace(view, depth=np.full((3, 4), depth, np.float32), mask=mask)
    with raises_key(told):
        run.refuse_empty([bad], scene)


def test_names_from_is_refused_when_no_objects_are_searched_for(stages: StageReporter, tmp_path: Path) -> None:
    request = LiftRequest(scene=tmp_path, names_from=tmp_path / "first", options={"objects": "none"})
    folder = LiftFolder.create(tmp_path / "lift", request)
    with raises_key("names-of-no-objects"):
        run.run_lift(folder, stages.events, StopSignal(folder.cancel_path), resume=False, make_fills=make_fills)


@pytest.mark.parametrize(
    ("changed", "shown"), [({}, True), ({"objects": "boxes"}, False), ({"one_class_an_object": False}, False)]
)
def test_a_lift_that_cannot_use_voted_labels_warns(
    changed: dict[str, object], shown: bool, stages: StageReporter, tmp_path: Path
) -> None:
    preset = replace(PRESETS["preview"], **changed)  # type: ignore[arg-type]
    assert preset.shows_votes == shown
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "none"))
    with pytest.raises(PlgsError), stages.stage("check") as progress:
        run.checked_frames(folder, preset, None, progress, stages.events)
    assert warnings_in(tmp_path / "events.jsonl") == ([] if shown else [run.NO_VOTES])


def test_the_manifest_names_the_version_of_the_code(stages: StageReporter, tmp_path: Path) -> None:
    """Where other code began the lift, both, also after a second resumption; and the user is told."""
    assert (
        run.code_of("new", None, stages.events)
        == run.code_of("new", Checkpoint(tmp_path, {"code": "new"}), stages.events)
        == "new"
    )
    assert not warnings_in(tmp_path / "events.jsonl")
    assert run.code_of("new", Checkpoint(tmp_path, {"code": "old"}), stages.events) == "old+new"
    assert run.code_of("new", Checkpoint(tmp_path, {"code": "old+new"}), stages.events) == "old+new"
    assert run.code_of("new", Checkpoint(tmp_path, {}), stages.events) == "unknown+new"
    told = warnings_in(tmp_path / "events.jsonl")
    assert len(told) == 2 and "other code began this lift (old, this is new)" in told[0]


@pytest.mark.parametrize(("seconds", "said"), [(3599.0, None), (90000.0, "predicted to take 25.0 h in all here")])
def test_a_long_lift_gives_a_warning(seconds: float, said: str | None, stages: StageReporter, tmp_path: Path) -> None:
    run.warn_if_long(Course({"train": seconds - 1, "bake": 1.0}), stages.events)
    told = warnings_in(tmp_path / "events.jsonl")
    assert [each for each in told if said and said in each] == told and bool(told) == bool(said)


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
def test_the_shown_time_left_follows_the_measured_pace(slowness: float) -> None:
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
def test_the_shown_time_left_of_a_recorded_lift_is_steady(slowness: float) -> None:
    course = Course({name: slowness * seconds for name, seconds in zip(STAGES, FORESEEN, strict=True)})
    ends = []
    for at, name, share, eta in LIFT:
        left = course.left(name, share, eta, course.began + at)
        assert left is not None
        ends.append(at + left)
    assert ends[LIFT.index((91.0, "train", 0.361, 101.3)) :] == pytest.approx([225.0] * 7, rel=0.25)
    jumps = [abs(after - before) for before, after in zip(ends, ends[1:], strict=False)]
    assert max(jumps) < 0.5 * 225.0


def test_the_time_left_of_a_resumed_lift_ignores_steps_done_before() -> None:
    course = Course(PREDICTED)
    now = course.began + 30.0
    course.skip("train", 0.5)
    assert course.left("train", 0.5, None, now) == pytest.approx(40.0)


def test_the_time_left_is_measured_anew_for_each_part_of_a_stage(
    stages: StageReporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening a long scene says nothing about the few frames that are then checked."""
    now = [0.0]
    reads = staticmethod(lambda: now[0])
    monkeypatch.setattr(job_progress, "time", type("Clock", (), {"monotonic": reads, "process_time": reads}))
    with stages.stage("check") as progress:
        for seconds, done, total in ((1.0, 0, 1000), (900.0, 900, 1000), (901.0, 1, 5), (902.0, 2, 5)):
            now[0] = seconds
            progress(done, total)
    said = [event.data["eta_s"] for event in EventReader(tmp_path / "events.jsonl").poll() if event.kind == "progress"]
    assert said == [None, 99.9, None, 3.0]
