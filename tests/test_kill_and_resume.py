"""The real engine, killed again and again and resumed, makes the very bytes that an undisturbed one makes."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from engine.job import EventReader, LiftFolder, LiftRequest, LiftState, verify
from tests.tiny_scene import write_tiny_scene

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
KILLED = Path(__file__).with_name("killed_engine.py")
MOMENTS = int(os.environ.get("PLGS_KILLS", "200"))


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


def run(at: int, counted: Path, *arguments: str | Path) -> int:
    """An engine that is killed at its change number ``at``; its exit code."""
    command = [sys.executable, KILLED, str(at), counted, *arguments]
    return subprocess.run([str(part) for part in command], stdout=subprocess.DEVNULL, timeout=600).returncode


def lift_of(folder: Path, scene: Path) -> Path:
    return LiftFolder.create(folder, LiftRequest(scene=scene, steps=24)).path


def test_a_dozen_moments_of_a_pretended_lift(tmp_path: Path) -> None:
    calm, rough, counted = (tmp_path / name for name in ("calm", "rough", "count"))
    lift_of(calm, tmp_path)
    assert run(0, counted, "fake", calm) == 0
    changes, chance = int(counted.read_text()), random.Random(0)
    for moment in sorted(chance.sample(range(1, changes), 12)):
        if not rough.exists():
            lift_of(rough, tmp_path)
        code = run(moment, counted, "fake", rough)  # a resumed lift has less to do, and may get to its end
        assert code in (-signal.SIGKILL, 0)
        assert LiftFolder.open(rough).state() in (LiftState.NOT_STARTED, LiftState.INTERRUPTED, LiftState.FINISHED)
        if code == 0:
            assert verify(rough / "result").files == verify(calm / "result").files
            rough.rename(tmp_path / f"rough {moment}")
    if rough.exists():
        assert run(0, counted, "fake", rough) == 0
        assert verify(rough / "result").files == verify(calm / "result").files


@pytest.mark.slow
def test_hundreds_of_moments_of_a_real_lift(tmp_path: Path) -> None:
    """All stages, the result, its manifest, and a bake of more frames."""
    scene, chance, counted = write_tiny_scene(tmp_path / "scene", frames=6), random.Random(0), tmp_path / "count"
    calm = lift_of(tmp_path / "calm", scene)
    assert run(0, counted, "lift", calm) == 0
    lifted = int(counted.read_text())
    assert run(0, counted, "bake", calm) == 0
    baked, whole, kills, number = int(counted.read_text()), verify(calm / "result").files, 0, 0
    while kills < MOMENTS:
        rough, number = lift_of(tmp_path / f"rough {number}", scene), number + 1
        for changes, *command in ((lifted, "lift", rough, "--resume"), (baked, "bake", rough)):
            while (code := run(chance.randrange(1, changes), counted, *command)) != 0:
                assert code == -signal.SIGKILL
                kills += 1
        assert verify(rough / "result").files == whole
