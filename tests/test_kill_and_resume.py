"""The real engine, killed again and again and resumed, makes the very bytes that an undisturbed one makes."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from engine.job import EventReader, LiftFolder, LiftRequest, LiftState, verify
from tests.killed_engine import Moment
from tests.tiny_scene import write_tiny_scene

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
KILLED = Path(__file__).with_name("killed_engine.py")
MOMENTS, SEED = int(os.environ.get("PLGS_KILLS", "200")), int(os.environ.get("PLGS_KILLS_SEED", "0"))
STEPS = 8


def engine(root: Path, *arguments: str | Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "engine", "lift", *arguments]
    env = os.environ | {"PLGS_ENGINE_PYTHON": sys.executable}
    return subprocess.Popen(command, cwd=root, env=env, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


@pytest.mark.slow
def test_the_same_bytes(root: Path, tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=6)
    options = [scene, "--steps", "24", "--bake", "test"]
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    assert engine(root, *options, "-o", calm).wait(timeout=300) == 0

    # Killed when the n-th stage begins, and once amid the training; `kill` takes the parent, the engine follows it.
    for stage, step in (("consistency", 0), ("train", 0), ("train", 9), ("result", 0), ("bake", 0), ("evaluate", 0)):
        process = engine(root, *options, "-o", rough, "--resume")
        reader = EventReader(rough / "events.jsonl", from_end=True)
        began = time.monotonic()
        while not any(
            event.data.get("name", event.data.get("stage")) == stage and int(str(event.data.get("step", 0))) >= step
            for event in reader.poll()
            if event.kind in ("stage", "progress")
        ):
            assert process.poll() is None and time.monotonic() - began < 120, (stage, step)
            time.sleep(0.01)
        process.kill()
        process.wait()
        lift = LiftFolder.open(rough)
        while lift.is_running:
            assert time.monotonic() - began < 125
            time.sleep(0.02)
        assert lift.state() is LiftState.CANCELLED
    assert engine(root, *options, "-o", rough, "--resume").wait(timeout=300) == 0
    assert verify(rough / "result").files == verify(calm / "result").files


def run(at: int, counted: Path, lift: Path) -> int:
    """A pretended engine that is killed at its change number ``at``; its exit code."""
    command = [sys.executable, KILLED, "fake", str(at), counted, lift]
    return subprocess.run([str(part) for part in command], stdout=subprocess.DEVNULL, timeout=600).returncode


def lift_of(folder: Path, scene: Path) -> Path:
    """As short as a lift can be that does all that a long one does: it is done many times."""
    request = LiftRequest(scene=scene, options={"steps": STEPS, "warm_start": False})
    return LiftFolder.create(folder, request).path


def test_a_dozen_moments_of_a_pretended_lift(tmp_path: Path) -> None:
    calm, rough, counted = (tmp_path / name for name in ("calm", "rough", "count"))
    lift_of(calm, tmp_path)
    assert run(0, counted, calm) == 0
    changes, chance = int(counted.read_text()), random.Random(0)
    for moment in sorted(chance.sample(range(1, changes), 12)):
        if not rough.exists():
            lift_of(rough, tmp_path)
        code = run(moment, counted, rough)  # a resumed lift has less to do, and may get to its end
        assert code in (-signal.SIGKILL, 0)
        assert LiftFolder.open(rough).state() in (LiftState.NOT_STARTED, LiftState.INTERRUPTED, LiftState.FINISHED)
        if code == 0:
            assert verify(rough / "result").files == verify(calm / "result").files
            rough.rename(tmp_path / f"rough {moment}")
    if rough.exists():
        assert run(0, counted, rough) == 0
        assert verify(rough / "result").files == verify(calm / "result").files


class Engines:
    """Real engines, one after another, with one thread each: forks of a process that has all loaded."""

    def __init__(self, scene: Path, folder: Path) -> None:
        one_thread = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")}
        command = [sys.executable, KILLED, "serve", scene, folder / "warm"]
        self._counted = folder / "count"
        self._server = subprocess.Popen(
            [str(part) for part in command], env=os.environ | one_thread, text=True, bufsize=1,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert self._answer() == 0

    def run(self, *arguments: str | Path, at: Moment | None = None) -> int:
        """An engine that is killed at a moment; its exit code."""
        assert self._server.stdin is not None
        asked = {"arguments": [str(part) for part in arguments], "at": at, "counted": str(self._counted)}
        self._server.stdin.write(json.dumps(asked) + "\n")
        return self._answer()

    def changes(self) -> dict[int, int]:
        """Changes to files in each stage of the last engine that got to its end."""
        return {int(stage): count for stage, count in json.loads(self._counted.read_text()).items()}

    def close(self) -> None:
        self._server.kill()
        self._server.wait()

    def _answer(self) -> int:
        assert self._server.stdout is not None
        return int(self._server.stdout.readline())


def log_of(lift: Path) -> str:
    """Its end."""
    return (lift / "log.txt").read_text()[-2000:]


def moments(chance: random.Random, changes: dict[int, int], count: int) -> list[Moment]:
    """Of all stages alike, in their order. Half of them are exactly before a change, the others up to 50 ms later."""
    stages = [*changes] * (count // len(changes)) + chance.sample([*changes], count % len(changes))
    delays = [0.0 if chance.random() < 0.5 else chance.uniform(0.0001, 0.05) for _ in stages]
    return sorted(
        Moment(stage, chance.randint(1, max(1, changes[stage])), delay)
        for stage, delay in zip(stages, delays, strict=True)
    )


@pytest.mark.slow
def test_hundreds_of_moments_of_a_real_lift(tmp_path: Path) -> None:
    """All stages, the result, its manifest, and a bake of more frames: each lift is killed a dozen times on its way,
    each bake some times, and each time gone on with; then the result has the bytes of one that nobody disturbed.
    """
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    chance = random.Random(SEED)
    engines = Engines(scene, tmp_path)
    calm = lift_of(tmp_path / "calm", scene)
    kills: Counter[tuple[str, int]] = Counter()
    try:
        assert engines.run("lift", calm) == 0
        lifted = engines.changes()
        assert engines.run("bake", calm) == 0
        baked, whole = engines.changes(), verify(calm / "result").files
        while kills.total() < MOMENTS:
            rough = lift_of(tmp_path / f"rough {kills.total()}", scene)
            for task, changes, count, more in (("lift", lifted, 12, ["--resume"]), ("bake", baked, 5, [])):
                for moment in moments(chance, changes, min(count, MOMENTS - kills.total())):
                    code = engines.run(task, rough, *more, at=moment)
                    assert code in (-signal.SIGKILL, -signal.SIGALRM, 0), (task, moment, log_of(rough))
                    kills[task, moment.stage] += code != 0
                assert engines.run(task, rough, *more) == 0, (task, log_of(rough))
            assert verify(rough / "result").files == whole
            shutil.rmtree(rough)
            print(f"{kills.total()} kills", flush=True)
    finally:
        engines.close()
    print("kills by task and stage:", dict(sorted(kills.items())))
