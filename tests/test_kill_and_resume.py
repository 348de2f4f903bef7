"""The real engine, killed again and again and resumed, makes the very bytes that an undisturbed one makes."""

import os
import random
import shutil
import signal
import sys
from collections import Counter
from pathlib import Path

import pytest

from engine.job import LiftFolder, LiftRequest, verify
from tests.killed_engine import Engines, Moment
from tests.tiny_scene import write_tiny_scene

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
MANY, SEED = int(os.environ.get("PLGS_KILLS", "200")), int(os.environ.get("PLGS_KILLS_SEED", "0"))
STEPS = 8


def lift_of(folder: Path, scene: Path) -> Path:
    """As short as a lift can be that does all that a long one does: it is done many times."""
    request = LiftRequest(scene=scene, options={"steps": STEPS, "warm_start": False})
    return LiftFolder.create(folder, request).path


def changes_of(engines: Engines) -> dict[int, int]:
    """Changes to files in each stage of the last engine, which got to its end."""
    return {int(stage): count for stage, count in engines.counted().items()}


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
    """All stages, the result, its manifest, and a bake of more frames: 12 kills a lift and 5 a bake, each resumed."""
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    chance = random.Random(SEED)
    engines = Engines(scene, tmp_path)
    calm = lift_of(tmp_path / "calm", scene)
    kills: Counter[tuple[str, int]] = Counter()
    try:
        assert engines.run("lift", calm) == 0
        lifted = changes_of(engines)
        assert engines.run("bake", calm) == 0
        baked, whole = changes_of(engines), verify(calm / "result").files
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
