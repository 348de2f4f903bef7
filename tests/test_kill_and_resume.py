"""The real engine, killed again and again and resumed, makes the very bytes that an undisturbed one makes."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from engine.job import LiftFolder, LiftRequest, verify
from tests.killed_engine import Moment
from tests.tiny_scene import write_tiny_scene

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
KILLED = Path(__file__).with_name("killed_engine.py")
MANY, SEED = int(os.environ.get("PLGS_KILLS", "200")), int(os.environ.get("PLGS_KILLS_SEED", "0"))
STEPS = 8


def lift_of(folder: Path, scene: Path) -> Path:
    """As short as a lift can be that does all that a long one does: it is done many times."""
    request = LiftRequest(scene=scene, options={"steps": STEPS, "warm_start": False})
    return LiftFolder.create(folder, request).path


class Engines:
    """Real engines, one after another, with one thread each: forks of a process that has all loaded."""

    def __init__(self, scene: Path, folder: Path) -> None:
        one_thread = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")}
        command = [sys.executable, KILLED, scene, folder / "warm"]
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


@pytest.mark.parametrize("kills_in_all", [17, pytest.param(MANY, marks=pytest.mark.slow)])
def test_a_lift_that_is_killed_and_resumed_has_the_same_bytes(tmp_path: Path, kills_in_all: int) -> None:
    """This covers all stages, the result, its manifest, and a bake of more frames. Each lift is killed a dozen times on
    its way, each bake five times, and each time it is resumed.
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
        while kills.total() < kills_in_all:
            rough = lift_of(tmp_path / f"rough {kills.total()}", scene)
            for task, changes, count, more in (("lift", lifted, 12, ["--resume"]), ("bake", baked, 5, [])):
                for moment in moments(chance, changes, min(count, kills_in_all - kills.total())):
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
