"""Tests in a real Blender's window, with the built zip installed: `make test-window` and `make test-blender-next`.

Those make the Debian tree that PLGS_WINDOW_TREE names; without it there is nothing here to run.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

AS_STARTED = {"test_pictures", "test_a_placed_lift_fits_the_view_beside_the_panels"}
AS_STARTED |= {"test_without_a_graphics_card_a_lift_opens_in_solid_shading"}
"""These look at Material Preview, which the extension turns to in a file as Blender starts it: files and tests."""

if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))

if "PLGS_WINDOW_TREE" in os.environ:
    from blender import Window
    from tree import ROOT, Tree, paths_of_this_python
else:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="session")
def work_folder(request: pytest.FixtureRequest) -> Iterator[Path]:
    """Seen by this machine and by the tree at the same path: put scenes and lifts of a test here.

    One for each run of the tests, so that two may run at once; a run with failures leaves it.
    """
    parent = ROOT / "build" / "window"
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="work-", dir=parent))
    yield folder
    if not request.session.testsfailed:
        shutil.rmtree(folder)


@pytest.fixture(scope="session")
def blender(work_folder: Path) -> Iterator[Window]:
    """Blender on its virtual screen, for all tests."""
    folder = (ROOT / os.environ["PLGS_WINDOW_TREE"]).resolve()
    packages = list((ROOT / "build").glob("plgs-*.zip"))
    assert len(packages) == 1, "build the extension first: make extension"
    tree = Tree(folder, [ROOT, *paths_of_this_python()])
    try:
        window = Window(tree, work_folder, packages[0])
        try:
            yield window
        finally:
            window.close()
    finally:
        tree.close()


@pytest.fixture
def window(blender: Window, request: pytest.FixtureRequest) -> Iterator[Window]:
    """Blender with a new file. A test that fails leaves a screenshot, and a Blender started again for the next one."""
    blender.new_file(is_solid=AS_STARTED.isdisjoint((request.path.stem, request.node.name)))
    failed_before = request.session.testsfailed
    yield blender
    if request.session.testsfailed > failed_before:
        blender.screenshot(f"failed-{request.node.name}")
        print(f"Blender said:\n{blender.log_tail()}")
        if blender.is_running:
            blender.kill()
