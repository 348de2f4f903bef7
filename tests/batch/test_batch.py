"""Batches on a real scheduler and real workers, in processes of their own. Most lifts are pretended: `farm_worker`."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine.batch import BatchPlan, SceneJob, cluster, run_batch, run_worker
from engine.batch.cluster import Place
from engine.batch.worker import Tls
from engine.command_line.main import main
from engine.errors import ExitCode, PlgsError
from engine.job import LiftFolder, LiftRequest, verify
from engine.job.terminal import Interrupted, Interrupts
from engine.machine.code_digest import code_digest
from tests.tiny_scene import write_tiny_scene

dask = pytest.importorskip("dask", reason="distributed is not installed: python -m engine add farm")
distributed = pytest.importorskip("distributed", reason="distributed is not installed: python -m engine add farm")
FARM_WORKER = Path(__file__).with_name("farm_worker.py")
PATIENCE_S = 60.0
USUAL_WAIT_S = cluster.NO_WORKER_S
Start = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def start(root: Path) -> Iterator[Start]:
    """Start programs, which end with the test."""
    started: list[subprocess.Popen[bytes]] = []

    def begin(*command: str | Path) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, *map(str, command)], cwd=root, stderr=subprocess.DEVNULL)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine needs more than five seconds to start a worker."""
    monkeypatch.setattr(cluster, "NO_WORKER_S", PATIENCE_S)


@pytest.fixture
def address(start: Start) -> str:
    return f"tcp://127.0.0.1:{started_scheduler(start)[1]}"


def started_scheduler(
    start: Start, port: int = 0, ttl: str = "60s", protocol: str = "tcp://", more: tuple[str | Path, ...] = ()
) -> tuple[subprocess.Popen[bytes], int]:
    if not port:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
    os.environ["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"] = ttl
    try:
        command = ("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard", "--port", str(port))
        scheduler = start(*command, "--protocol", protocol, *more)
    finally:
        del os.environ["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"]
    give_up = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return scheduler, port
        except ConnectionRefusedError:
            assert time.monotonic() < give_up and scheduler.poll() is None
            time.sleep(0.1)


def plan_of(folder: Path, *names: str) -> BatchPlan:
    jobs = []
    for name in names:
        scene = folder / "scenes" / name
        scene.mkdir(parents=True)
        if name == "dark":
            (scene / "dark").touch()
        jobs.append(SceneJob(name, folder / "out" / name, LiftRequest(scene=scene)))
    return BatchPlan(folder / "out", tuple(jobs))


def run(plan: BatchPlan, place: Place) -> ExitCode:
    with Interrupts() as interrupts, interrupts.deferred():
        return run_batch(plan, place, interrupts)


def rows_of(plan: BatchPlan) -> dict[str, dict[str, str]]:
    with (plan.output / "table.csv").open() as file:
        return {row["scene"]: row for row in csv.DictReader(file)}


def hellos(lift: Path) -> list[dict[str, object]]:
    lines = (lift / "events.jsonl").read_text().splitlines() if (lift / "events.jsonl").exists() else []
    return [told for line in lines if (told := json.loads(line))["event"] == "hello"]


def in_the_middle(lift: Path, runs: int = 1) -> int:
    """Wait until a lift trains, in its run of this number, and return the number of the worker's process."""
    give_up = time.monotonic() + PATIENCE_S
    while not is_training(lift, runs):
        assert time.monotonic() < give_up
        time.sleep(0.02)
    status = Path(f"/proc/{hellos(lift)[-1]['pid']}/status").read_text()
    return int(status.split("PPid:")[1].split()[0])


def is_training(lift: Path, runs: int) -> bool:
    if len(hellos(lift)) < runs:
        return False
    *_, latest = (lift / "events.jsonl").read_text().split('"event": "hello"')
    return latest.count('"event": "progress"') > 10


def meanwhile(act: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=act)
    thread.start()
    return thread


def test_scenes_are_shared_and_a_failed_one_is_a_row(
    tmp_path: Path, start: Start, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_of(tmp_path, "a", "b", "dark", "c")
    for _ in range(2):
        start(FARM_WORKER, "usual", address)
    assert run(plan, Place(scheduler=address)) is ExitCode.BAD_INPUT
    rows = rows_of(plan)
    assert [row["state"] for row in rows.values()] == ["done", "done", "failed", "done", ""]
    assert "is too dark" in rows["dark"]["reason"] and "| dark | failed |" in capsys.readouterr().out
    assert (plan.output / "table.md").read_text().count("\n") == 7
    began = {name: hellos(plan.output / name) for name in ("a", "b", "c", "dark")}
    (plan.jobs[2].request.scene / "dark").unlink()
    assert run(plan, Place(scheduler=address)) is ExitCode.FINISHED  # what was missing, and no more
    assert [row["state"] for row in rows_of(plan).values()] == ["done"] * 4 + [""]
    again = {name: hellos(plan.output / name) for name in began}
    assert {name for name in began if again[name] != began[name]} == {"dark"}


def test_a_killed_worker_loses_little_and_its_work_goes_elsewhere(tmp_path: Path, start: Start, address: str) -> None:
    plan = plan_of(tmp_path, "a", "b")
    for _ in range(2):
        start(FARM_WORKER, "usual", address)
    killing = meanwhile(lambda: os.kill(in_the_middle(plan.output / "a"), signal.SIGKILL))
    assert run(plan, Place(scheduler=address)) is ExitCode.FINISHED
    killing.join()
    assert [each["resumed"] for each in hellos(plan.output / "a")] == [False, True]
    assert len(hellos(plan.output / "b")) == 1
    verify(plan.output / "a" / "result")


@pytest.mark.parametrize(
    ("number", "kills", "state"),
    [(signal.SIGKILL, 1, "done"), (signal.SIGTERM, 1, "done"), (signal.SIGKILL, 2, "failed")],
)
def test_an_engine_that_is_killed_is_resumed_once(
    number: signal.Signals, kills: int, state: str, tmp_path: Path, start: Start, address: str
) -> None:
    plan = plan_of(tmp_path, "a", "b")
    for _ in range(2):
        start(FARM_WORKER, "usual", address)

    def kill() -> None:
        for runs in range(1, kills + 1):
            in_the_middle(plan.output / "a", runs)
            os.kill(int(str(hellos(plan.output / "a")[-1]["pid"])), number)

    killing = meanwhile(kill)
    code = run(plan, Place(scheduler=address))
    killing.join()
    assert [row["state"] for row in rows_of(plan).values()] == [state, "done", ""]
    assert (code is ExitCode.FINISHED) == (state == "done")
    assert [each["resumed"] for each in hellos(plan.output / "a")] == [False, True]
    assert "signal" in rows_of(plan)["a"]["reason"] or state == "done"


def test_a_batch_on_this_machine_is_not_reached_from_others() -> None:
    """Neither its scheduler, nor the dashboard, nor its workers; and with a worker less it goes on."""
    with cluster.opened(Place(workers=2)) as farm:
        numbers = [os.getpid(), *(worker.pid for worker in farm.own)]
        give_up = time.monotonic() + PATIENCE_S
        while len(farm.workers()) < 2:
            assert time.monotonic() < give_up
            time.sleep(0.1)
        listening = {each for number in numbers for each in sockets_of(number)}
        first = next(iter(farm.workers().values()))
        assert farm.use_fewer(f"machine {first['name']}") and len(farm.own) == 1
        while len(there := farm.workers()) > 1:
            assert time.monotonic() < give_up
            time.sleep(0.1)
        assert first["name"] not in [told["name"] for told in there.values()] and not farm.use_fewer("machine")
    assert len(listening) >= 4 and {host for host, _ in listening} == {"127.0.0.1"}


def sockets_of(process: int) -> Iterator[tuple[str, int]]:
    """The addresses at which a process listens."""
    links = [os.readlink(each) for each in Path(f"/proc/{process}/fd").iterdir() if each.is_symlink()]
    for table, family in (("tcp", socket.AF_INET), ("tcp6", socket.AF_INET6)):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if state == "0A" and f"socket:[{inode}]" in links:
                host, port = local.split(":")
                raw = b"".join(bytes.fromhex(host[k : k + 8])[::-1] for k in range(0, len(host), 8))
                yield socket.inet_ntop(family, raw), int(port, 16)


def test_two_batches_in_one_folder(tmp_path: Path, start: Start, address: str) -> None:
    """One waits for the lifts of the other, and the table has the scenes of both."""
    plan = plan_of(tmp_path, "a", "b", "c")
    for _ in range(3):
        start(FARM_WORKER, "usual", address)
    other = start(FARM_WORKER, "batch", address, plan.output, *(job.request.scene for job in plan.jobs[:2]))
    half = BatchPlan(plan.output, plan.jobs[1:])
    assert run(half, Place(scheduler=address)) is ExitCode.FINISHED
    assert other.wait(PATIENCE_S) == 0
    states = {name: row["state"] for name, row in rows_of(plan).items()}
    assert states == {"a": "done", "b": "done", "c": "done", "mean": ""}
    assert len(hellos(plan.output / "b")) == 1


def certificates(folder: Path) -> tuple[Path, Path]:
    """An authority's certificate, and one that it signed, with its key."""

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca")
    openssl("req", "-newkey", "rsa:2048", "-nodes", "-keyout", "own.key", "-out", "own.csr", "-subj", "/CN=own")
    openssl("x509", "-req", "-in", "own.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-out", "own.crt")
    (folder / "own.pem").write_text((folder / "own.crt").read_text() + (folder / "own.key").read_text())
    return folder / "ca.pem", folder / "own.pem"


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make certificates")
def test_with_tls(tmp_path: Path, start: Start) -> None:
    """With certificates of the same authority it works; without them, nobody gets in."""
    ca, own = certificates(tmp_path)
    files = ("--tls-ca-file", ca, "--tls-cert", own, "--tls-key", own)
    address = f"tls://127.0.0.1:{started_scheduler(start, protocol='tls://', more=files)[1]}"
    tls = Tls(ca, own)
    plan = plan_of(tmp_path, "a")
    with pytest.raises(PlgsError, match="begins with tls://"):
        run(plan, Place(scheduler=address.replace("tls://", "tcp://"), tls=tls))
    with pytest.raises(PlgsError, match="TLS cannot be used"):
        run(plan, Place(scheduler=address, tls=Tls(ca, ca)))
    with pytest.raises(PlgsError, match="no scheduler answers"):
        run(plan, Place(scheduler=address.replace("tls://", "tcp://")))
    start(FARM_WORKER, "usual", address, ca, own)
    assert run(plan, Place(scheduler=address, tls=tls)) is ExitCode.FINISHED


def test_a_worker_that_hangs(tmp_path: Path, start: Start) -> None:
    """The scheduler gives it up. Its engine lives, so the other worker waits for that, and finds the lift finished."""
    address = f"tcp://127.0.0.1:{started_scheduler(start, ttl='5s')[1]}"
    plan = plan_of(tmp_path, "a")
    for _ in range(2):
        start(FARM_WORKER, "usual", address)
    hanging = meanwhile(lambda: os.kill(in_the_middle(plan.output / "a"), signal.SIGSTOP))
    assert run(plan, Place(scheduler=address)) is ExitCode.FINISHED
    hanging.join()
    assert rows_of(plan)["a"]["state"] == "done" and len(hellos(plan.output / "a")) == 1


def test_a_scheduler_that_is_restarted(tmp_path: Path, start: Start) -> None:
    scheduler, port = started_scheduler(start)
    address = f"tcp://127.0.0.1:{port}"
    plan = plan_of(tmp_path, "a", "b", "c")
    for _ in range(2):
        start(FARM_WORKER, "usual", address)

    def restart() -> None:
        in_the_middle(plan.output / "a")
        scheduler.kill()
        scheduler.wait()
        started_scheduler(start, port)

    restarting = meanwhile(restart)
    assert run(plan, Place(scheduler=address)) is ExitCode.FINISHED
    restarting.join()
    assert {row["state"] for row in rows_of(plan).values()} == {"done", ""}


def test_ctrl_c_leaves_everything_resumable(tmp_path: Path, start: Start, address: str) -> None:
    plan = plan_of(tmp_path, "a", "b")
    start(FARM_WORKER, "usual", address)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    stopping = meanwhile(lambda: (in_the_middle(plan.output / "a"), os.kill(os.getpid(), signal.SIGINT)))
    with pytest.raises(Interrupted):
        run(plan, Place(scheduler=address))
    stopping.join()
    assert not LiftFolder.open(plan.output / "a").is_running
    assert [row["state"] for row in rows_of(plan).values()] == ["stopped", "stopped", ""]
    assert run(plan, Place(scheduler=address)) is ExitCode.FINISHED
    assert [each["resumed"] for each in hellos(plan.output / "a")] == [False, True]


@pytest.mark.parametrize("unfit", ["unmounted", pytest.param("full", marks=pytest.mark.slow)])
def test_what_one_worker_cannot_do_another_does(
    unfit: str, tmp_path: Path, start: Start, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_of(tmp_path, "a", "b")
    start(FARM_WORKER, unfit, address)
    start(FARM_WORKER, "usual", address)
    with distributed.Client(address) as client:
        client.wait_for_workers(2, timeout=PATIENCE_S)
    assert run(plan, Place(scheduler=address)) is ExitCode.FINISHED
    said = {"unmounted": "does not exist on this worker", "full": "the disk is full"}[unfit]
    assert said in capsys.readouterr().err


def test_what_no_worker_can_do_is_reported(tmp_path: Path, start: Start, address: str) -> None:
    plan = plan_of(tmp_path, "a")
    start(FARM_WORKER, "unmounted", address)
    assert run(plan, Place(scheduler=address)) is not ExitCode.FINISHED
    reason = rows_of(plan)["a"]["reason"]
    assert "no worker can do it" in reason and "does not exist on this worker" in reason
    assert ".." not in reason, "the sentence of each worker ends once"


def test_a_scheduler_without_workers_says_so_within_ten_seconds(
    tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "NO_WORKER_S", USUAL_WAIT_S)
    began = time.monotonic()
    with pytest.raises(PlgsError, match="it has no workers.*python -m engine worker"):
        run(plan_of(tmp_path, "a"), Place(scheduler=address))
    assert time.monotonic() - began < 10.0


def test_workers_with_another_engine_get_nothing(
    tmp_path: Path, start: Start, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "NO_WORKER_S", 20.0)
    start(FARM_WORKER, "another-engine", address)
    plan = plan_of(tmp_path, "a")
    with pytest.raises(PlgsError, match="different engines .plgs-0.0.0-00000000.; this one is plgs-"):
        run(plan, Place(scheduler=address))
    assert not (plan.output / "a").exists()


def test_no_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    with pytest.raises(PlgsError, match="no scheduler answers"):
        run(plan_of(tmp_path, "a"), Place(scheduler="tcp://127.0.0.1:9"))


@pytest.mark.parametrize("address", ["nonsense", "machine:8786", "tcp://machine", "tcp://a b:1"])
def test_an_invalid_address(address: str, tmp_path: Path) -> None:
    with pytest.raises(PlgsError, match="is not the address of a scheduler"):
        run(plan_of(tmp_path, "a"), Place(scheduler=address))
    with pytest.raises(PlgsError, match="is not the address of a scheduler"):
        run_worker(address)


@pytest.mark.parametrize("options", ["--slurm --scheduler tcp://a:1", "--workers 2 --scheduler tcp://a:1", "--queue q"])
def test_options_of_two_places(options: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["batch", str(tmp_path / "a"), "-o", str(tmp_path / "out"), *options.split()]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_lift_for_which_no_worker_is_large_enough(tmp_path: Path, start: Start, address: str) -> None:
    plan = plan_of(tmp_path, "a")
    job = SceneJob("a", plan.jobs[0].lift, plan.jobs[0].request, gigabytes=1e6)
    start(FARM_WORKER, "usual", address)
    large = BatchPlan(plan.output, (job,))
    assert run(large, Place(scheduler=address)) is not ExitCode.FINISHED
    assert "needs about 1000000.0 GB" in rows_of(large)["a"]["reason"]


@pytest.mark.slow
def test_from_the_command_line_on_this_machine(tmp_path: Path, root: Path) -> None:
    """Real lifts, bakes in pieces, an export and scores, by workers that the batch starts."""
    write_tiny_scene(tmp_path / "room", frames=8, noise=0.1)
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    command = [sys.executable, "-m", "engine", "batch", tmp_path / "room", tmp_path / "empty", "-o", out]
    command += "--workers 2 --preset preview --steps 10 --bake all --chunk 4 --export boxes".split()
    (tmp_path / "scratch").mkdir()
    variables = {**os.environ, "TMPDIR": str(tmp_path / "scratch")}
    said = subprocess.run([*map(str, command)], cwd=root, env=variables, capture_output=True, text=True, timeout=200)
    assert said.returncode == ExitCode.BAD_INPUT, said.stderr
    assert not list((tmp_path / "scratch").glob("plgs-worker-*"))
    assert "Dashboard: http://127.0.0.1:" in said.stderr and "| room | done |" in said.stdout
    files = {file.path.name for file in verify(out / "room" / "result").files}
    assert {f"{frame:04d}.exr" for frame in range(8)} <= files
    assert (out / "room" / "exports" / "boxes" / "boxes.csv").exists()
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert float(rows[0]["miou"]) > 0.2 and rows[2] | {"seconds": ""} == rows[0] | {
        "scene": "mean", "state": "", "seconds": "", "code": "",
    }  # fmt: skip
    assert rows[0]["code"] == code_digest("engine")
    assert "no scene of a known format" in rows[1]["reason"]
