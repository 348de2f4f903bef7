"""What a new process spends before the first picture, with an empty cache and a full one.

Processor time is measured, so that the figures do not depend on the machine's load.
"""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NO_HOME = "/dev/null/home"  # cannot be made by anybody, root included
COLD_SECONDS, WARM_SECONDS = 30.0, 1.0
ANNOUNCEMENT = "compiling the forward pass of the rasteriser for this machine, about 10 s, once"
LISTEN = """
import json, logging, time
import numba, numpy as np, torch
lines = []
handler = logging.Handler()
handler.emit = lambda record: lines.append(record.getMessage())
logging.getLogger("plgs").addHandler(handler)
logging.getLogger("plgs").setLevel(logging.INFO)
"""
RENDER = f"""{LISTEN}
start = time.process_time()
from engine.machine import compiled
from engine.raster import rasterize
from tests.raster.room_workload import room_workload
work = room_workload(200, 64, 48)
tensors = [torch.from_numpy(array).requires_grad_() for array in
    (work.means, work.scales, work.quats, work.opacities, work.colours, work.labels)]
out = rasterize(*tensors, work.camera_to_world, work.intrinsics, work.width, work.height)
(out.image.sum() + out.labels.sum()).backward()
seconds = time.process_time() - start
print(json.dumps({{"seconds": seconds, "lines": lines, "cache": str(compiled.CACHE_FOLDER)}}))
"""
DRAW = f"""{LISTEN}
from engine.raster import rasterize
from engine.raster.blending import backward
one = [torch.ones(shape) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1, 3))]
rasterize(*one, None, np.eye(4), np.eye(3), 8, 8)
assert not backward.blend_backward.signatures
print(json.dumps(lines))
"""


@dataclass(frozen=True)
class Run:
    """``seconds`` of processor time after importing torch and Numba; the rasteriser's log, its cache folder."""

    seconds: float
    lines: list[str]
    cache: Path


def environment(**changes: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "PLGS_", "XDG_"))}
    return kept | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"} | changes


def render_in_a_process(code: Path, **changes: str) -> Run:
    variables = environment(**changes) | {"PYTHONPATH": str(code)}
    done = subprocess.run(
        [sys.executable, "-c", RENDER], cwd=code, env=variables, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout.splitlines()[-1])
    return Run(row["seconds"], row["lines"], Path(row["cache"]))


@pytest.fixture(scope="module")
def read_only_code(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Engine and room in a read-only folder; ``listing`` shows whether somebody (root may) wrote to it."""
    code = tmp_path_factory.mktemp("code")
    shutil.copytree(ROOT / "engine", code / "engine", ignore=shutil.ignore_patterns("__pycache__"))
    room = Path("tests/raster/room_workload.py")
    (code / room.parent).mkdir(parents=True)
    shutil.copy(ROOT / room, code / room)
    for path in [code, *code.rglob("*")]:
        path.chmod(path.stat().st_mode & ~0o222)
    return code


def listing(folder: Path) -> list[tuple[str, int]]:
    return sorted((str(path), path.stat().st_mtime_ns) for path in folder.rglob("*"))


@pytest.fixture(scope="module")
def cold(read_only_code: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    cache = str(tmp_path_factory.mktemp("cache"))
    before = listing(read_only_code)
    run = render_in_a_process(read_only_code, NUMBA_CACHE_DIR=cache, HOME=NO_HOME)
    assert listing(read_only_code) == before
    assert str(run.cache).startswith(cache)
    return run


@pytest.mark.slow
def test_the_first_start_compiles_kernels_and_says_so(cold: Run) -> None:
    print(f"cold start: {cold.seconds:.1f} s")
    assert ANNOUNCEMENT in cold.lines
    assert cold.seconds <= COLD_SECONDS


@pytest.mark.slow
def test_a_second_start_of_the_rasterizer_is_quick(cold: Run, read_only_code: Path) -> None:
    cache = str(cold.cache.parent)
    runs = [render_in_a_process(read_only_code, NUMBA_CACHE_DIR=cache, HOME=NO_HOME) for _ in range(3)]
    seconds = [run.seconds for run in runs]
    print("warm starts:", ", ".join(f"{own:.2f} s" for own in seconds))
    assert all(run.cache == cold.cache and ANNOUNCEMENT not in run.lines for run in runs)
    assert min(seconds) <= WARM_SECONDS


@pytest.mark.slow
def test_drawing_does_not_compile_the_backward_pass(tmp_path: Path) -> None:
    variables = environment(NUMBA_CACHE_DIR=str(tmp_path))
    done = subprocess.run([sys.executable, "-c", DRAW], env=variables, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert ANNOUNCEMENT in done.stdout


@pytest.mark.slow
def test_the_rasterizer_works_without_a_home_folder(read_only_code: Path, tmp_path: Path) -> None:
    """Machine code goes to a temporary folder of this process if no other folder will do."""
    before = listing(read_only_code)
    run = render_in_a_process(read_only_code, HOME=NO_HOME, TMPDIR=str(tmp_path))
    assert run.cache.parent == tmp_path
    assert run.cache.name.startswith("plgs-kernels-")
    assert listing(read_only_code) == before
