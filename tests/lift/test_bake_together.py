"""Real processes that bake one lift at once, each its own views."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.job import LiftFolder, verify
from engine.job.follower import TaskFollower, start_bake
from engine.job.process import engine_call
from engine.job.task import TaskState
from tests.lift.test_bake_more import finished, write_cameras  # noqa: F401 - the fixture
from tests.waiting import PATIENCE_S, wait_until


@pytest.fixture
def lift(finished: dict[str, LiftFolder], tmp_path: Path) -> LiftFolder:  # noqa: F811
    return LiftFolder.open(shutil.copytree(finished["test"].path, tmp_path / "lift"))


@pytest.fixture
def followers() -> Iterator[list[TaskFollower]]:
    """Those of the test, ended with it."""
    started: list[TaskFollower] = []
    yield started
    for follower in started:
        follower.kill()
        follower.close()


def ended(*followers: TaskFollower) -> None:
    def have_ended() -> bool:
        for follower in followers:
            follower.poll()
        return not any(follower.is_running for follower in followers)

    wait_until(have_ended)


def begun(follower: TaskFollower) -> None:
    """Its engine holds the lift's lock, or has told of itself."""
    wait_until(lambda: follower.poll() or not follower.is_running)
    assert follower.is_running


def shot(path: Path, name: str, count: int) -> tuple[Path, set[str]]:
    names = [f"{name}.{number:04d}" for number in range(count)]
    return write_cameras(path, names), set(names)


def test_followed_bakes_do_not_disturb_each_other(
    lift: LiftFolder, followers: list[TaskFollower], tmp_path: Path, quick_python: Path
) -> None:
    """Two bake their views to the end, though a third is cancelled beside them."""
    names = {}
    for name, count in (("left", 40), ("right", 12), ("cancelled", 40)):
        cameras, names[name] = shot(tmp_path / f"{name}.json", name, count)
        followers.append(start_bake(lift, quick_python, cameras=cameras))
        begun(followers[-1])
    left, right, cancelled = followers
    cancelled.cancel()
    ended(*followers)
    assert (left.error, right.error) == (None, None)
    assert [each.state for each in followers] == [TaskState.FINISHED, TaskState.FINISHED, TaskState.CANCELLED]
    for follower in followers:
        follower.close()
    baked = {file.path.stem for file in verify(lift.result_path).files if file.path.suffix == ".exr"}
    assert baked - names["cancelled"] == {"0004"} | names["left"] | names["right"]
    assert not names["cancelled"] <= baked
    assert not [path for path in (lift.path / "bake").iterdir() if not path.name.startswith(("view-", "manifest"))]
    assert not [*lift.path.glob("bake-*"), *lift.path.rglob(".part-*")]


def test_two_commands_share_the_frames(lift: LiftFolder, root: Path, quick_python: Path) -> None:
    command = [*engine_call(quick_python), "bake", lift.path]
    processes = [subprocess.Popen([*map(str, command)], cwd=root, stdout=subprocess.DEVNULL) for _ in range(2)]
    try:
        assert [process.wait(PATIENCE_S) for process in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    files = [file.path.name for file in verify(lift.result_path).files if file.path.suffix == ".exr"]
    assert files == [f"{number:04d}.exr" for number in range(6)]
