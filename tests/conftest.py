"""What every test stands on: the repository on sys.path, Blender without the user's settings, the extension as `plgs`.

Blender comes first: bpy crashes when it is imported after open3d in one process.
"""

import atexit
import faulthandler
import gc
import importlib.util
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent


def load_package(root: Path, name: str) -> ModuleType:
    """Import the extension, whose root is the repository's, as `name` whatever the checkout's folder is called."""
    spec = importlib.util.spec_from_file_location(name, root / "__init__.py", submodule_search_locations=[str(root)])
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


sys.path.insert(0, str(ROOT))

def pytest_collection_finish() -> None:
    """Leave all that was imported to no later collection of garbage, each of which takes a second with it."""
    gc.collect()
    gc.freeze()


_exit_codes: list[int] = []
_END_S = 120.0


def pytest_sessionfinish(exitstatus: int) -> None:
    _exit_codes.append(int(exitstatus))


def pytest_unconfigure() -> None:
    """What hangs from here on, such as a thread that is waited for, is told with the tracebacks of all threads."""
    faulthandler.dump_traceback_later(_END_S, exit=True, file=2)


@atexit.register  # first, so it runs last: the folders below are gone by then
def _end_the_process() -> None:
    """End here, without C++'s destructors. Blender's sound waits in one of them for ever when a reference to bpy is
    left over, for then Blender was not closed before."""
    if HAS_BLENDER and _exit_codes:
        from plgs_blender.lifecycle import drop_session_folder

        drop_session_folder(Path(bpy.app.tempdir))
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_exit_codes[-1])


# The same examples each time, however busy the machine is; `make search` looks for others (profile "search").
_busy = [HealthCheck.too_slow]
settings.register_profile("same", derandomize=True, deadline=None, database=None, suppress_health_check=_busy)
settings.register_profile("search", deadline=None, database=None, suppress_health_check=_busy, print_blob=True)
settings.load_profile("same")

# As the engine's command has it: threads that wait do not spin. Read when torch is first imported. Beside another
# worker's test one thread does a tiny lift in 19 s, and two on shared cores in 32.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Nobody's list of lifts, nobody's measured speed: what a test runs as an engine takes this folder too.
os.environ["PLGS_CACHE_DIR"] = tempfile.mkdtemp(prefix="plgs-cache-")
atexit.register(shutil.rmtree, os.environ["PLGS_CACHE_DIR"], ignore_errors=True)

HAS_BLENDER = importlib.util.find_spec("bpy") is not None
if HAS_BLENDER:
    # Before bpy is imported, here or in a process that a test starts: nobody's preferences, nobody's extensions.
    settings = tempfile.mkdtemp(prefix="plgs-tests-")
    atexit.register(shutil.rmtree, settings, ignore_errors=True)
    os.environ["BLENDER_USER_RESOURCES"] = settings
    import bpy

    load_package(ROOT, "plgs")

collect_ignore = [] if HAS_BLENDER else ["plgs_blender"]


def pytest_report_header() -> str:
    return f"Blender {bpy.app.version_string}" if HAS_BLENDER else "no bpy: the Blender side is not tested"


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def quick_python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The engine's Python, without the seconds in which it imports the engine: see `forked_engine`."""
    if sys.platform == "win32":
        yield Path(sys.executable)
        return
    from tests.forked_engine import forked_engines

    with forked_engines(tmp_path_factory.mktemp("engine")) as python:
        yield python


@pytest.fixture
def engines_are_forks(quick_python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command or an operator starts is no fresh engine."""
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", str(quick_python))


@pytest.fixture
def plgs() -> ModuleType:
    """The extension's root package; `from plgs.plgs_blender import …` works at the top of a test too."""
    if not HAS_BLENDER:
        pytest.skip("needs bpy")
    return sys.modules["plgs"]


@pytest.fixture
def extension(plgs: ModuleType) -> Iterator[None]:
    """The extension, switched on in an empty file."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    plgs.register()
    yield
    plgs.unregister()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
