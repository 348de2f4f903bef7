"""Batches on a real scheduler and real workers, in processes of their own. Most lifts are pretended: `farm_worker`."""

import os
import signal
from pathlib import Path

import pytest

from engine.batch import BatchPlan
from engine.batch.cluster import FarmOptions
from engine.errors import ExitCode
from engine.job import LiftFolder, verify
from engine.job.terminal import Interrupted
from tests.batch import farm_worker
from tests.batch.farm import Farm, hellos, in_the_middle, meanwhile, pause, plan_of, rows_of, run
from tests.waiting import PATIENCE_S

distributed = pytest.importorskip("distributed", reason="distributed is not installed: python -m engine add farm")


def test_workers_share_the_scenes(tmp_path: Path, farm: Farm, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    plan = plan_of(tmp_path, "a", "b", "dark", "c")
    farm.workers(address, "usual", "usual")
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.BAD_INPUT
    rows = rows_of(plan)
    assert [row["state"] for row in rows.values()] == ["done", "done", "failed", "done", ""]
    assert "is too dark" in rows["dark"]["reason"] and "| dark | failed |" in capsys.readouterr().out
    assert (plan.output / "table.md").read_text().count("\n") == 7
    began = {name: hellos(plan.output / name) for name in ("a", "b", "c", "dark")}
    (plan.jobs[2].request.scene / "dark").unlink()
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED  # what was missing, and no more
    assert [row["state"] for row in rows_of(plan).values()] == ["done"] * 4 + [""]
    again = {name: hellos(plan.output / name) for name in began}
    assert {name for name in began if again[name] != began[name]} == {"dark"}


def test_another_worker_resumes_the_lift_of_a_killed_worker(tmp_path: Path, farm: Farm, address: str) -> None:
    plan = plan_of(tmp_path, "a", "b")
    farm.workers(address, "usual", "usual")
    pause(plan.jobs[0])
    killing = meanwhile(lambda: os.kill(in_the_middle(plan.output / "a"), signal.SIGKILL))
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    killing.join()
    assert [each["resumed"] for each in hellos(plan.output / "a")] == [False, True]
    assert len(hellos(plan.output / "b")) == 1
    verify(plan.output / "a" / "result")


@pytest.mark.parametrize(("number", "kind"), [(signal.SIGTERM, "usual"), (signal.SIGSTOP, "impatient")])
def test_a_killed_lift_is_resumed(number: signal.Signals, kind: str, tmp_path: Path, farm: Farm, address: str) -> None:
    plan = plan_of(tmp_path, "a")
    farm.workers(address, kind)
    pause(plan.jobs[0])

    def disturb() -> None:
        in_the_middle(plan.output / "a")
        os.kill(int(str(hellos(plan.output / "a")[-1]["pid"])), number)

    disturbing = meanwhile(disturb)
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    disturbing.join()
    assert [each["resumed"] for each in hellos(plan.output / "a")] == [False, True]


def test_two_batches_can_run_in_one_output_folder(tmp_path: Path, farm: Farm, address: str) -> None:
    """One waits for the lifts of the other, and the table has the scenes of both."""
    plan = plan_of(tmp_path, "a", "b", "c")
    farm.workers(address, *["usual"] * 3)
    other = farm.start(farm_worker.batch, address, plan.output, *(job.request.scene for job in plan.jobs[:2]))
    half = BatchPlan(plan.output, plan.jobs[1:])
    assert run(half, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    other.join(PATIENCE_S)
    assert other.exitcode == 0
    states = {name: row["state"] for name, row in rows_of(plan).items()}
    assert states == {"a": "done", "b": "done", "c": "done", "mean": ""}
    assert len(hellos(plan.output / "b")) == 1


@pytest.mark.slow
def test_a_batch_finishes_when_one_of_its_workers_hangs(tmp_path: Path, farm: Farm) -> None:
    """The scheduler gives it up. Its engine lives, so the other worker waits for that, and finds the lift finished."""
    address = f"tcp://127.0.0.1:{farm.scheduler(ttl_s=5.0)[1]}"
    plan = plan_of(tmp_path, "a")
    farm.workers(address, "usual", "usual")
    paused = pause(plan.jobs[0])
    hanging = meanwhile(lambda: (os.kill(in_the_middle(plan.output / "a"), signal.SIGSTOP), paused.unlink()))
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    hanging.join()
    assert rows_of(plan)["a"]["state"] == "done" and len(hellos(plan.output / "a")) == 1


def test_a_batch_survives_a_restart_of_its_scheduler(tmp_path: Path, farm: Farm) -> None:
    scheduler, port = farm.scheduler()
    address = f"tcp://127.0.0.1:{port}"
    plan = plan_of(tmp_path, "a", "b", "c")
    farm.workers(address, "usual", "usual")

    paused = pause(plan.jobs[0])

    def restart() -> None:
        in_the_middle(plan.output / "a")
        scheduler.kill()
        scheduler.join()
        farm.scheduler(port)
        paused.unlink()

    restarting = meanwhile(restart)
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    restarting.join()
    assert {row["state"] for row in rows_of(plan).values()} == {"done", ""}


def test_ctrl_c_leaves_every_scene_of_a_batch_resumable(tmp_path: Path, farm: Farm, address: str) -> None:
    plan = plan_of(tmp_path, "a", "b")
    farm.workers(address, "usual")
    pause(plan.jobs[0])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    stopping = meanwhile(lambda: (in_the_middle(plan.output / "a"), os.kill(os.getpid(), signal.SIGINT)))
    with pytest.raises(Interrupted):
        run(plan, FarmOptions(scheduler=address))
    stopping.join()
    assert not LiftFolder.open(plan.output / "a").is_running
    assert [row["state"] for row in rows_of(plan).values()] == ["stopped", "stopped", ""]
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    assert [each["resumed"] for each in hellos(plan.output / "a")] == [False, True]


@pytest.mark.parametrize("unfit", ["unmounted", pytest.param("full", marks=pytest.mark.slow)])
def test_a_scene_that_one_worker_cannot_do_goes_to_another_worker(
    unfit: str, tmp_path: Path, farm: Farm, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_of(tmp_path, "a", "b")
    farm.workers(address, unfit, "usual")
    with distributed.Client(address) as client:
        client.wait_for_workers(2, timeout=PATIENCE_S)
    assert run(plan, FarmOptions(scheduler=address)) is ExitCode.FINISHED
    said = {"unmounted": "does not exist on this worker", "full": "the disk is full"}[unfit]
    assert said in capsys.readouterr().err
