"""What docs/farms.md promises of one machine; tests/batch has the faults of several."""

import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2
import pytest

from engine.job import verify
from engine.machine.code_digest import code_digest
from tests.batch.farm import PORTS, answers
from tests.batch.test_cluster import certificates
from tests.batch.test_slurm import SBATCH, SCANCEL
from tests.doors.terminal import ROOT, Terminal
from tests.raises_key import worded
from tests.tiny_scene import write_tiny_scene
from tests.waiting import wait_until

BATCH = ".venv/bin/python -m engine batch scans/* -o OUT --preset standard --bake all --export coco"
OF_A_TABLE = ".venv/bin/python -m engine batch --scenes scans.csv -o OUT --preset standard"
OF_TLS = ".venv/bin/python -m engine batch scans/* -o OUT --scheduler tls://machine:8786 --tls-ca ca.pem --tls-certificate own.pem"  # noqa: E501
WORKER = ".venv/bin/python -m engine worker tls://machine:8786 --tls-ca ca.pem --tls-certificate own.pem"
SCHEDULER = "dask scheduler --protocol tls:// --tls-ca-file ca.pem --tls-cert own.pem --tls-key own.pem"
QUICK = ("--steps", "5", "--set", "warm_start=false", "--size", "64x48", "--workers", "1")


def rows_of(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "table.csv").open(newline="") as file:
        return {row["scene"]: row for row in csv.DictReader(file)}


@pytest.mark.slow
def test_a_batch_table_has_a_row_for_each_scene_and_a_second_run_continues(shell: Terminal) -> None:
    pytest.importorskip("distributed")
    write_tiny_scene(shell.folder / "scans/room", 6, noise=0.1)
    (shell.folder / "scans/empty").mkdir(parents=True)
    told = shell.run(BATCH, code=2, OUT="out", more=QUICK)
    out = shell.folder / "out"
    assert "| room | done |" in told and "Dashboard: http://127.0.0.1:" in told
    made = {each.path.name for each in verify(out / "room/result").files}
    assert {f"{number:04d}.exr" for number in range(6)} <= made
    content = json.loads((out / "room/exports/coco/panoptic.json").read_text())
    assert len(content["images"]) == 6 and any(each["name"] == "chair" for each in content["categories"])
    rows = rows_of(out)
    assert rows["room"]["state"] == "done" and float(rows["room"]["miou"]) > 0.05
    assert rows["room"]["code"] == code_digest("engine") and worded("no-format").search(rows["empty"]["reason"])
    assert rows["mean"]["miou"] == rows["room"]["miou"]
    before = (out / "room/events.jsonl").read_bytes()
    assert "| room | done |" in shell.run(BATCH, code=2, OUT="out", more=QUICK)
    assert (out / "room/events.jsonl").read_bytes() == before, "nothing was missing"
    # A table gives each scene its own options, and adds its rows.
    write_tiny_scene(shell.folder / "scans/old/room", 6, up="y")
    table = "scene,name,up,masks,classes,set\nscans/old/room,old-room,y,,,voxel_size=0.3\n"
    (shell.folder / "scans.csv").write_text(table)
    shell.run(OF_A_TABLE, OUT="out", more=QUICK)
    request = json.loads((out / "old-room/request.json").read_text())
    assert request["overrides"]["voxel_size"] == 0.3 and request["up"] == "y"
    assert rows_of(out)["old-room"]["state"] == "done" and "room" in rows_of(out), "the earlier scene's row stays"
    assert (out / "table.md").read_text().count("| done |") == 2
    # Changed photos make a row failed; where masks have changed it lifts again.
    photo = shell.folder / "scans/room/color/0004.png"
    before = photo.read_bytes()
    cv2.imwrite(str(photo), cv2.imread(str(photo)) // 2)
    assert "the photo or the depth of 0004 differs" in shell.run(BATCH, code=2, OUT="out", more=QUICK)
    assert rows_of(out)["room"]["state"] == "failed"
    photo.write_bytes(before)
    table = shell.folder / "scans/room/panoptic.json"
    table.write_text(table.read_text().replace('"chair"', '"seat"'))
    shell.run(BATCH, code=2, OUT="out", more=QUICK)
    assert rows_of(out)["room"]["state"] == "done" and "seat 1" in (out / "room/result/instances.json").read_text()


@contextmanager
def running(shell: Terminal, printed: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A command that does not end by itself, in a Python of its own."""
    words = printed.replace(".venv/bin/python", sys.executable).split()
    if words[0] == "dask":
        words[0] = str(Path(sys.executable).with_name("dask"))
    with log.open("wb") as out:
        process = subprocess.Popen(
            words, cwd=shell.folder, stdout=out, stderr=out, env={**os.environ, "PYTHONPATH": str(ROOT)}
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make certificates")
def test_a_batch_over_tls_reports_its_rows_as_events(shell: Terminal, tmp_path: Path) -> None:
    """Of a table in TOML, which lies in another folder than the batch is started in."""
    pytest.importorskip("distributed")
    certificates(shell.folder)
    write_tiny_scene(shell.folder / "scans/room", 6, masks="none")
    write_tiny_scene(shell.folder / "scans/masks/here", 6)
    table = '[[scene]]\nscene = "room"\nname = "here"\nset = ["voxel_size=0.2"]\n'
    (shell.folder / "scans/scans.toml").write_text(table)
    port = next(each for each in random.sample(PORTS, 100) if not answers(each))
    at = f"tls://127.0.0.1:{port}"
    listen = f" --host 127.0.0.1 --port {port} --no-dashboard"
    with ExitStack() as both:
        scheduler = both.enter_context(running(shell, SCHEDULER + listen, tmp_path / "scheduler.txt"))
        wait_until(lambda: answers(port) or scheduler.poll() is not None)
        worker = WORKER.replace("tls://machine:8786", at) + " --memory 4 --threads 1"
        both.enter_context(running(shell, worker, tmp_path / "worker.txt"))
        command = OF_TLS.replace("tls://machine:8786", at).replace("scans/*", "--scenes scans/scans.toml")
        more = [*QUICK[:-2], "--masks", "'scans/masks/{scene}/panoptic.json'", "--progress", "json"]
        command = " ".join([command.replace("OUT", "out"), *more])
        ran = subprocess.run(command, shell=True, cwd=shell.folder, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr + (tmp_path / "worker.txt").read_text()
    events = [json.loads(line) for line in ran.stdout.splitlines()]
    [row] = [each for each in events if each["event"] == "metric" and each["name"] == "scene"]
    [answer] = [each for each in events if each["event"] == "answer"]
    assert row["values"]["scene"] == "here" and row["values"]["state"] == "done" and events[-1]["state"] == "finished"
    assert [each["scene"] for each in answer["answer"]["rows"]] == ["here"]
    assert json.loads((shell.folder / "out/here/request.json").read_text())["overrides"]["voxel_size"] == 0.2
    assert "chair 1" in (shell.folder / "out/here/result/instances.json").read_text()


@pytest.mark.slow
def test_after_ctrl_c_unfinished_scenes_are_marked_stopped_in_the_table(shell: Terminal, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    for name in ("a", "b"):
        write_tiny_scene(shell.folder / "scans" / name, 6)
    command = ".venv/bin/python -m engine batch scans/a scans/b -o out --workers 1 --steps 20000"
    with running(shell, command, tmp_path / "said.txt") as batch:
        events = shell.folder / "out/a/events.jsonl"
        wait_until(lambda: batch.poll() is not None or (events.exists() and '"train"' in events.read_text()))
        batch.send_signal(signal.SIGINT)
        assert batch.wait(60) == 130
    assert "Stopped. Give the same command again to continue: out" in (tmp_path / "said.txt").read_text()
    assert [row["state"] for row in rows_of(shell.folder / "out").values()] == ["stopped", "stopped", ""]


@pytest.mark.slow
def test_on_slurm_dask_jobqueue_starts_one_worker_per_job(shell: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    """By an sbatch of the test's own, which runs the job at once."""
    pytest.importorskip("dask_jobqueue")
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (shell.folder / name).write_text(text.format(folder=shell.folder))
        (shell.folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{shell.folder}{os.pathsep}{os.environ['PATH']}")
    write_tiny_scene(shell.folder / "scans/room", 6)
    options = "--slurm --workers 1 --memory 4 --threads 2 --queue gpu --account film --walltime 12:00:00"
    try:
        shell.run(BATCH.replace(" --bake all --export coco", ""), OUT="out", more=[*QUICK[:-2], options])
    finally:
        for job in (shell.folder / "jobs").read_text().split():
            subprocess.run(["kill", "-9", f"-{job}"], capture_output=True)
    script = (shell.folder / "job.sh").read_text().splitlines()
    for option in ("-p gpu", "-A film", "-t 12:00:00", "--cpus-per-task=2", "--mem=4G"):
        assert f"#SBATCH {option}" in script
    assert rows_of(shell.folder / "out")["room"]["state"] == "done"


def test_studio_defaults_are_used_and_the_first_line_names_their_file(shell: Terminal) -> None:
    """A scene that has its masks elsewhere: without the defaults it would be refused for want of masks."""
    write_tiny_scene(shell.folder / "scans/room", 6, masks="none")
    write_tiny_scene(shell.folder / "masks/room", 6)
    defaults = 'preset = "preview"\nmasks = "masks/{scene}/panoptic.json"\nmemory = 0.5\n'
    (shell.folder / "studio.toml").write_text(defaults)
    command = [".venv/bin/python", "-m", "engine", "lift", "scans/room", "-o", "out"]
    variables = {**os.environ, "PLGS_DEFAULTS": str(shell.folder / "studio.toml")}
    ran = subprocess.run(command, cwd=shell.folder, env=variables, capture_output=True, text=True)
    assert ran.stderr.startswith(f"{shell.folder / 'studio.toml'} sets ") and "masks" in ran.stderr.splitlines()[0]
    assert ran.returncode == 2 and "0.5 GB" in ran.stderr, "less memory than a lift needs"
    first = subprocess.run(
        [*command, "--preset", "draft"], cwd=shell.folder, env=variables, capture_output=True, text=True
    ).stderr.splitlines()[0]
    assert "masks" in first and "preset" not in first, "an option that is given comes first"
    (shell.folder / "studio.toml").write_text('presets = "preview"\n')
    ran = subprocess.run(command, cwd=shell.folder, env=variables, capture_output=True, text=True)
    assert ran.returncode == 2 and "presets" in ran.stderr, "other keys are refused"


def test_resuming_ignores_new_studio_defaults(
    terminal: Terminal, lifted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (terminal.folder / "studio.toml").write_text('preset = "paper"\ndevice = "auto"\nmemory = 64\n')
    monkeypatch.setenv("PLGS_DEFAULTS", str(terminal.folder / "studio.toml"))
    before = (terminal.folder / "lifts/demo/request.json").read_bytes()
    for command in ("lift lifts/demo --resume", f"lift {lifted}/scans/room -o lifts/demo --resume --bake test"):
        told = terminal.run(f".venv/bin/python -m engine {command}")
        assert "finished already" in told and "demo/result/gaussians.ply" in told, "and what it made, as at first"
    assert worded("lift-begun").search(terminal.run(".venv/bin/python -m engine lift lifts/demo", code=2))
    assert (terminal.folder / "lifts/demo/request.json").read_bytes() == before


def test_a_batch_with_the_same_scene_twice_is_refused(shell: Terminal) -> None:
    pytest.importorskip("distributed")
    write_tiny_scene(shell.folder / "scans/room", 2)
    (shell.folder / "scans.csv").write_text("scene,name\nscans/room,a\nscans/room,b\n")
    assert worded("scene-twice").search(shell.run(OF_A_TABLE, code=2, OUT="out"))
