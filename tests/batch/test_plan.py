"""A batch writes nowhere but into its own folders, and what an earlier one did counts only while all of it is there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from engine.batch.plan import BatchPlan, Row, SceneJob, done_before, names_of, remember
from engine.errors import PlgsError
from engine.job import LiftRequest
from engine.job.manifest import write_manifest


@pytest.mark.parametrize("name", ["...zip", "..zip", ".batch.zip", "table.md.zip", "Table.CSV.zip"])
def test_a_name_that_is_not_a_folder_of_its_own_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).touch()
    with pytest.raises(PlgsError, match=r"Rename the scene\.$"):
        names_of([tmp_path / name])


def test_a_scene_that_is_given_twice(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    with pytest.raises(PlgsError, match=r"^the scene is given twice: .*room\. Name it once\.$"):
        names_of([tmp_path / "room", tmp_path / "room" / ".." / "room"])


@pytest.mark.parametrize("other", ["y/room", "y/Room", "y/ROOM.zip"])
def test_two_scenes_with_the_same_name(other: str, tmp_path: Path) -> None:
    for scene in (tmp_path / "x" / "room", tmp_path / other):
        scene.mkdir(parents=True) if not scene.suffix else (scene.parent.mkdir(), scene.touch())
    with pytest.raises(PlgsError, match="two scenes"):
        names_of([tmp_path / "x" / "room", tmp_path / other])


def test_a_folder_is_named_after_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "a" / "-o").mkdir(parents=True)
    assert names_of([tmp_path / "a" / "-o" / ".." / "-o", tmp_path / "a" / "-o" / ".."]) == ["-o", "a"]


@pytest.mark.parametrize("lost", ["result/passes/0001.exr", "exports/ply"])
def test_missing_results_are_not_counted_as_done(lost: str, tmp_path: Path) -> None:
    job = SceneJob("room", tmp_path / "room", LiftRequest(scene=tmp_path / "scene"))
    plan = BatchPlan(tmp_path, (job,), exports=("ply",))
    for name in ("result/passes/0001.exr", "exports/ply/splats.ply"):
        (job.lift / name).parent.mkdir(parents=True)
        (job.lift / name).write_text("all of it")
    write_manifest(job.lift / "result", versions={}, seed=0, settings={}, timings={})
    row = Row("room", "done", 1.0, "", 0, {})
    remember(plan, job, row)
    assert done_before(plan, job) == row
    path = job.lift / lost
    shutil.rmtree(path) if path.is_dir() else path.write_text("half")
    assert done_before(plan, job) is None
