"""Workers as jobs of Slurm: the job script as text, and as a fake sbatch runs it."""

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed: python -m engine add farm")
# ruff: noqa: E402 - without it the rest is not tested
from engine.batch import cluster as cluster_module
from engine.batch import run as run_module
from engine.batch.cluster import FarmOptions, Tls, slurm_cluster
from engine.errors import ExitCode
from tests.batch.farm import plan_of, rows_of, run
from tests.batch.test_cluster import certificates
from tests.raises_key import raises_key

SBATCH = """#!/bin/sh
cp "$1" {folder}/job.sh  # as Slurm does
setsid sh {folder}/job.sh > {folder}/job.log 2>&1 &
echo $! >> {folder}/jobs
echo Submitted batch job $!
"""
SQUEUE = """#!/bin/sh
for job in $(cat {folder}/jobs); do kill -0 $job 2>/dev/null && echo $job && exit; done
echo slurm_load_jobs error: Invalid job id specified >&2
exit 1
"""
SCANCEL = """#!/bin/sh
kill "$@"
"""


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder with the job's script and log, of a Slurm that runs a job at once."""
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        program = tmp_path / "bin" / name
        program.parent.mkdir(exist_ok=True)
        program.write_text(text.format(folder=tmp_path))
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    yield tmp_path
    for job in (tmp_path / "jobs").read_text().split() if (tmp_path / "jobs").exists() else []:
        with suppress(ProcessLookupError):
            os.killpg(int(job), signal.SIGKILL)


def test_a_slurm_batch_is_refused_without_slurm_installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with raises_key("no-slurm"):
        slurm_cluster(FarmOptions(2, "", {}))


@pytest.mark.parametrize("refuses", [True, False])
def test_a_failed_slurm_job_makes_its_scene_fail(refuses: bool, slurm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """sbatch refuses the job, or the job ends before its worker begins: the batch does not wait for ever."""
    monkeypatch.setattr(run_module, "_JOBS_S", 0.5)
    squeue = slurm / "bin" / "squeue"
    squeue.write_text(SQUEUE.format(folder=slurm))
    squeue.chmod(0o755)
    python = slurm / "python"
    python.write_text("#!/bin/sh\necho no such library >&2\nexit 1\n")
    python.chmod(0o755)
    monkeypatch.setattr(cluster_module.sys, "executable", str(python))
    if refuses:
        (slurm / "bin" / "sbatch").write_text("#!/bin/sh\necho sbatch: error: invalid partition >&2\nexit 1\n")
    plan = plan_of(slurm, "a", "b")
    farm_options = FarmOptions(1, "", {}, 1.0, 1, logs=plan.output / ".batch" / "jo bs")
    assert run(plan, farm_options) is ExitCode.BAD_INPUT
    for row in (rows_of(plan)[name] for name in "ab"):
        assert row["state"] == "failed"
        assert ("invalid partition" if refuses else "no such library") in row["reason"]


@pytest.mark.parametrize("name", ["queue", "account", "walltime"])
@pytest.mark.parametrize("value", ["gpu\nrm -rf /", "a b", "a\tb", "a\rb", "\u2028"])
def test_slurm_options_with_blanks_are_refused(name: str, value: str, slurm: Path) -> None:
    with raises_key(f"slurm-option --{name}"):
        slurm_cluster(FarmOptions(1, "", {name: value}))


ODD = 'it\'s $(touch oops) "a" `touch oops` b;touch oops #%s'


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make certificates")
def test_paths_in_slurm_job_scripts_are_quoted_for_the_shell(slurm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The job runs this Python with these files whatever their folders are called, and nothing of its start folder."""
    odd = slurm / ODD
    odd.mkdir()
    ca, own = certificates(odd)
    python = odd / "python"
    python.write_text('#!/bin/sh\nfor each; do echo "$each"; done > said\nenv >> said\n')
    python.chmod(0o755)
    monkeypatch.setattr(cluster_module.sys, "executable", str(python))
    monkeypatch.setattr(cluster_module, "ROOT", odd)
    with slurm_cluster(FarmOptions(1, "", {"queue": "gpu"}, 1.0, 1, Tls(ca, own))) as cluster:
        (slurm / "job.sh").write_text(cluster.job_script())
    monkeypatch.setenv("PYTHONHOME", "/nowhere")
    subprocess.run(["sh", "job.sh"], cwd=slurm, check=True, timeout=60)
    said = (slurm / "said").read_text().splitlines()
    assert said[:3] == ["-P", "-m", "distributed.cli.dask_worker"] and not (slurm / "oops").exists()
    assert {str(ca), str(own), f"PYTHONPATH={odd}"} < {*said} and "PYTHONHOME=/nowhere" not in said


def test_a_slurm_job_imports_nothing_from_its_folder(
    slurm: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("dask", "distributed", "engine"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("open('oops', 'w')\nraise SystemExit(9)\n")
    with slurm_cluster(FarmOptions(1, "", {}, 1.0, 1)) as cluster:
        (slurm / "job.sh").write_text(re.sub(r"tcp://\S+", "--version", cluster.job_script()))
    assert subprocess.run(["sh", "job.sh"], cwd=slurm, capture_output=True, timeout=60).returncode == 0
    assert not (slurm / "oops").exists()
