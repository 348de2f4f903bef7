"""A lift folder, and an engine that pretends to lift in it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.job import LiftFolder
from engine.job.follower import TaskFollower
from tests.job.following import Start, new_lift, start_fake


@pytest.fixture
def folder(tmp_path: Path) -> LiftFolder:
    return new_lift(tmp_path)


@pytest.fixture
def start(folder: LiftFolder) -> Iterator[Start]:
    followers = []

    def start_one(behaviour: str, resume: bool = False) -> TaskFollower:
        followers.append(start_fake(folder, behaviour, *(["--resume"] if resume else [])))
        return followers[-1]

    yield start_one
    for follower in followers:
        follower.kill()
        follower.close()
