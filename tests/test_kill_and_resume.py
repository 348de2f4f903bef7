"""The real engine, killed again and again and resumed, makes the very bytes that an undisturbed one makes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from engine.job import EventReader, LiftFolder, LiftState, verify
from tests.tiny_scene import write_tiny_scene

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")]


def engine(root: Path, *arguments: str | Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "engine", "lift", *arguments]
    env = os.environ | {"PLGS_ENGINE_PYTHON": sys.executable}
    return subprocess.Popen(command, cwd=root, env=env, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


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
