"""Where a batch finds its workers, and who may reach them."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.batch import BatchPlan, SceneJob, cluster, run_worker
from engine.batch.cluster import FarmOptions, Tls
from engine.command_line.main import main
from engine.errors import ExitCode
from tests.batch import farm_worker
from tests.batch.farm import Farm, plan_of, rows_of, run
from tests.raises_key import raises_key
from tests.waiting import PATIENCE_S, wait_until

distributed = pytest.importorskip("distributed", reason="distributed is not installed: python -m engine add farm")
USUAL_WAIT_S = cluster.NO_WORKER_S


def test_a_local_batch_accepts_no_connection_from_other_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither its scheduler, nor the dashboard, nor its workers; and with a worker less it goes on."""
    monkeypatch.setattr(cluster, "NO_WORKER_S", PATIENCE_S)
    with cluster.opened(FarmOptions(workers=2)) as farm:
        numbers = [os.getpid(), *(worker.pid for worker in farm.own)]
        wait_until(lambda: len(farm.workers()) == 2)
        listening = {each for number in numbers for each in sockets_of(number)}
        first = next(iter(farm.workers().values()))
        assert farm.use_fewer(f"machine {first['name']}") and len(farm.own) == 1
        wait_until(lambda: len(farm.workers()) == 1)
        assert first["name"] not in [worker["name"] for worker in farm.workers().values()] and not farm.use_fewer(
            "machine"
        )
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
def test_a_batch_without_tls_cannot_use_a_scheduler_with_tls(tmp_path: Path, farm: Farm) -> None:
    """With certificates of the same authority it works; without them, nobody gets in."""
    ca, own = certificates(tmp_path)
    options = f"--protocol tls:// --tls-ca-file {ca} --tls-cert {own} --tls-key {own}".split()
    address = f"tls://127.0.0.1:{farm.scheduler(0, 60.0, *options)[1]}"
    tls = Tls(ca, own)
    plan = plan_of(tmp_path, "a")
    with raises_key("address-without-tls"):
        run(plan, FarmOptions(scheduler=address.replace("tls://", "tcp://"), tls=tls))
    with raises_key("bad-tls"):
        run(plan, FarmOptions(scheduler=address, tls=Tls(ca, ca)))
    with raises_key("no-scheduler"):
        run(plan, FarmOptions(scheduler=address.replace("tls://", "tcp://")))
    farm.start(farm_worker.work, "usual", address, ca, own)
    assert run(plan, FarmOptions(scheduler=address, tls=tls)) is ExitCode.FINISHED


def test_a_scheduler_without_workers_is_reported(tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the seconds that it allows; here workers get half a second, and the machine as long as it takes."""
    assert cluster.CONNECT_S + USUAL_WAIT_S <= 10.0
    monkeypatch.setattr(cluster, "NO_WORKER_S", 0.5)
    with raises_key("no-worker"):
        run(plan_of(tmp_path, "a"), FarmOptions(scheduler=address))


def test_another_engine_gets_no_work(tmp_path: Path, farm: Farm, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    farm.workers(address, "another-engine")
    with distributed.Client(address) as client:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    monkeypatch.setattr(cluster, "NO_WORKER_S", 1.0)
    plan = plan_of(tmp_path, "a")
    with raises_key("no-worker plgs-0.0.0-00000000 plgs-"):
        run(plan, FarmOptions(scheduler=address))
    assert not (plan.output / "a").exists()


def test_a_scheduler_that_does_not_answer_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    with raises_key("no-scheduler"):
        run(plan_of(tmp_path, "a"), FarmOptions(scheduler="tcp://127.0.0.1:9"))


@pytest.mark.parametrize("address", ["nonsense", "machine:8786", "tcp://machine", "tcp://a b:1"])
def test_an_invalid_scheduler_address_is_refused(address: str, tmp_path: Path) -> None:
    with raises_key("scheduler-address"):
        run(plan_of(tmp_path, "a"), FarmOptions(scheduler=address))
    with raises_key("scheduler-address"):
        run_worker(address)


@pytest.mark.parametrize("options", ["--slurm --scheduler tcp://a:1", "--workers 2 --scheduler tcp://a:1", "--queue q"])
def test_conflicting_options_are_refused(options: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["batch", str(tmp_path / "a"), "-o", str(tmp_path / "out"), *options.split()]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_lift_that_needs_more_memory_than_any_worker_has_fails(tmp_path: Path, farm: Farm, address: str) -> None:
    plan = plan_of(tmp_path, "a")
    job = SceneJob("a", plan.jobs[0].lift, plan.jobs[0].request, gigabytes=1e6)
    farm.workers(address, "usual")
    large = BatchPlan(plan.output, (job,))
    assert run(large, FarmOptions(scheduler=address)) is not ExitCode.FINISHED
    assert "needs about 1000000.0 GB" in rows_of(large)["a"]["reason"]
