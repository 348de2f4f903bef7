"""Which process bakes which view."""

from __future__ import annotations

from pathlib import Path

from engine.job import BakeLocks
from engine.job.lock import FileLock
from engine.job.system import OPEN_FILES_KEEP_NAMES


def test_each_view_belongs_to_one_process(tmp_path: Path) -> None:
    with BakeLocks(tmp_path) as locks:
        with locks.claim("shot / 1") as first, locks.claim("shot / 1") as second, locks.claim("shot / 2") as other:
            assert (first, second, other) == (True, False, True)
        with locks.claim("shot / 1") as again:
            assert again
        assert OPEN_FILES_KEEP_NAMES or not list((tmp_path / "bake").glob("view-*.lock")), "none is left behind"


def test_it_knows_whether_others_are_baking(tmp_path: Path) -> None:
    assert not BakeLocks(tmp_path).others_at_work()
    with BakeLocks(tmp_path) as locks:
        assert not locks.others_at_work()
        left_behind = tmp_path / "bake" / "process-0.lock"
        left_behind.touch()  # by a kill: nobody holds it
        assert not locks.others_at_work()
        with FileLock(left_behind):
            assert locks.others_at_work()
    assert not (tmp_path / "bake").joinpath(locks._own.name).exists()


def test_one_after_the_other_at_the_manifest(tmp_path: Path) -> None:
    with BakeLocks(tmp_path) as locks, locks.manifest():
        pass
    with locks.manifest():
        pass
