"""What a batch does when workers come and go, and when a scene fails. The farm is pretended."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from engine.batch import piece, run
from engine.batch.cluster import FarmOptions
from engine.batch.piece import Ended, Kind, Outcome, Piece, do, engine_tag
from engine.batch.plan import RECORDS, BatchPlan, SceneJob
from engine.errors import ErrorCode, PlgsError
from engine.job import LiftRequest
from engine.job.terminal import Interrupts
from tests.job.following import FAKE, command_after_another
from tests.raises_key import raises_key, worded


@dataclass(eq=False)
class Future:
    piece: Piece
    workers: list[str] | None
    outcome: Outcome | None = None
    status: str = "pending"

    def done(self) -> bool:
        return self.outcome is not None

    def result(self) -> Outcome | None:
        return self.outcome

    def cancel(self) -> None:
        self.status = "cancelled"

    def cancelled(self) -> bool:
        return self.status == "cancelled"


@dataclass
class Farm:
    """Also its own client."""

    there: dict[str, dict[str, Any]]
    status: str = "running"
    address: str = "tcp://here:1"
    slurm: object | None = None
    asked: list[Future] = field(default_factory=list)
    left: list[str] = field(default_factory=list)

    @property
    def client(self) -> Farm:
        return self

    def submit(self, do: object, piece: Piece, *, workers: list[str] | None, **_: object) -> Future:
        self.asked.append(Future(piece, workers))
        return self.asked[-1]

    def workers(self) -> dict[str, dict[str, Any]]:
        return self.there

    def refuse_dead_jobs(self) -> None:
        """All live."""

    def largest(self) -> float:
        return 0.0

    def use_fewer(self, name: str) -> bool:
        self.left.append(name)
        return True


class Line:
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    def ended(self, row: run.Row) -> None:
        self.said.append(row.state)


class Batch:
    """A batch of one scene whose clock is ours."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, *workers: str) -> None:
        self.now = 0.0
        monkeypatch.setattr(run.time, "monotonic", lambda: self.now)
        job = SceneJob("a", folder / "a", LiftRequest(scene=folder / "scene"))
        self.farm, self.line = Farm({worker: {"name": worker} for worker in workers}), Line()
        self.rows: dict[str, run.Row] = {}
        plan = BatchPlan(folder, (job,), chunk=1)
        self.batch = run._Batch(plan, self.farm, self.line, self.rows)  # type: ignore[arg-type]
        scene = self.batch._scenes["a"] = run._Scene(job, 0, iter(()))
        scene.stages = self.batch._stages(scene)
        self.batch._next_stage(scene)

    def end(self, future: Future, ended: Ended, worker: str = "", lacked: bool = False, **answer: Any) -> None:
        why = "why." if ended is not Ended.DONE else ""
        future.outcome = Outcome(future.piece, ended, 1.0, why, 0, worker, answer, lacked)
        self.batch._take_in()

    def look(self, after: float = 2.0) -> None:
        self.now += after
        self.batch._look_at_workers()


def test_a_failed_bake_cancels_the_other_bakes_of_its_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = Batch(tmp_path, monkeypatch, "one")
    batch.end(batch.farm.asked[0], Ended.DONE, frames=["1", "2", "3"])
    bakes = batch.farm.asked[1:]
    assert [each.piece.kind for each in bakes] == [Kind.BAKE] * 3
    batch.end(bakes[1], Ended.FAILED)
    assert batch.rows["a"].state == "failed" and not batch.batch._out
    assert [each.status for each in bakes] == ["cancelled", "pending", "cancelled"]


def test_a_worker_with_a_new_address_keeps_its_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = Batch(tmp_path, monkeypatch, "one", "two")
    batch.end(batch.farm.asked[0], Ended.ELSEWHERE, "host one")
    assert batch.farm.asked[1].workers == ["two"]
    del batch.farm.there["two"]
    batch.look()
    assert len(batch.farm.asked) == 2  # it may come back
    batch.farm.there["three"] = {"name": "two"}
    batch.look()
    assert batch.farm.asked[1].status == "cancelled" and batch.farm.asked[2].workers == ["three"]
    del batch.farm.there["three"]
    batch.look()
    batch.look(run.RETURN_S + 2.0)
    assert worded("no-fit-worker").search(batch.rows["a"].reason)


def test_a_batch_without_workers_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = Batch(tmp_path, monkeypatch, "one")
    gone, batch.farm.there = batch.farm.there, {}
    batch.look()
    assert not batch.line.said
    for _ in range(2):
        batch.look(run.RETURN_S + 2.0)
    assert batch.line.said == ["Waiting for a worker. Start one: python -m engine worker tcp://here:1"]
    batch.farm.there = gone
    batch.look()
    batch.farm.there = {}
    batch.look(run.RETURN_S + 2.0)
    assert len(batch.line.said) == 2


@pytest.mark.parametrize("lacked", [False, True])
def test_a_killed_batch_lift_is_resumed_once(lacked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where memory was short, with a worker less."""
    batch = Batch(tmp_path, monkeypatch, "one", "two")
    batch.end(batch.farm.asked[0], Ended.KILLED, "host one", lacked)
    assert len(batch.farm.asked) == 2 and not batch.rows
    assert batch.farm.left == (["host one"] if lacked else [])
    about = ", with a worker less, as memory was short" if lacked else ""
    assert batch.line.said == [f"a: why. It will be resumed once{about}."]
    batch.end(batch.farm.asked[1], Ended.KILLED, "host two", lacked)
    assert len(batch.farm.asked) == 2 and batch.rows["a"].state == "failed" and batch.rows["a"].exit_code


@pytest.mark.parametrize("name", [RECORDS, f"{RECORDS}/table.lock", f"{RECORDS}/row.json"])
def test_links_in_place_of_the_batch_records_are_refused(name: str, tmp_path: Path) -> None:
    outside, path = tmp_path / "outside", tmp_path / "out" / name
    outside.mkdir()
    path.parent.mkdir(parents=True)
    path.symlink_to(outside if name == RECORDS else outside / "file")
    with raises_key("foreign-file") as refused:
        run.run_batch(BatchPlan(tmp_path / "out", ()), FarmOptions(), Interrupts())
    assert refused.value.where == str(path) and not [*outside.iterdir()]


@pytest.mark.parametrize("kind", [Kind.LIFT, Kind.EXPORT, Kind.SCORE])
def test_a_scene_that_is_not_mounted_goes_to_another_worker(kind: Kind, tmp_path: Path) -> None:
    work = Piece(kind, "room", tmp_path, LiftRequest(scene=tmp_path / "unmounted"), engine_tag(), ("ply",))
    outcome = do(work, lambda progress: None)
    assert outcome.ended is Ended.ELSEWHERE and "unmounted" in outcome.reason


def test_a_lift_finished_by_another_batch_counts_as_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(piece, "engine_command", command_after_another)
    (tmp_path / "room").mkdir()
    lift = Piece(Kind.LIFT, "room", tmp_path / "lift", LiftRequest(scene=tmp_path / "room"), engine_tag())
    outcome = do(lift, lambda progress: None)
    assert outcome.ended is Ended.DONE, outcome.reason


def test_a_lift_cancelled_while_it_starts_ends_as_cancelled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By another batch: the engine deletes the cancel file, as it takes it for an earlier run's."""
    cancel = "import sys, runpy, pathlib; pathlib.Path(sys.argv[3], 'cancel').touch(); sys.argv = sys.argv[1:]"
    begin = f"{cancel}; runpy.run_path(sys.argv[0], run_name='__main__')"

    def command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
        return [python, "-c", begin, FAKE, "patient", lift, *(["--resume"] if resume else [])]

    monkeypatch.setattr(piece, "engine_command", command)
    (tmp_path / "room").mkdir()
    lift = Piece(Kind.LIFT, "room", tmp_path / "lift", LiftRequest(scene=tmp_path / "room"), engine_tag())
    outcome = do(lift, lambda progress: None)
    assert outcome.ended is Ended.CANCELLED, outcome.reason


def test_an_error_can_be_sent_between_processes() -> None:
    error = PlgsError("made-up", "is dark", "room", "Add light.", code=ErrorCode.NO_MASKS, option="--masks")
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) and vars(again) == vars(error)
