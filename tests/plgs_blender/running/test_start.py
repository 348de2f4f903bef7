"""From the panel to a lift: what is refused, and the advice that comes with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import plgs
import pytest
from plgs.engine.job import JobError, LiftFolder, LiftRequest
from plgs.plgs_blender.running import lifts, start


@pytest.fixture(autouse=True)
def extension() -> Iterator[None]:
    plgs.register()
    yield
    lifts.let_go()
    plgs.unregister()


def test_what_to_do_about_a_lift_that_is_running(tmp_path: Path) -> None:
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "room"))
    scene = bpy.context.scene
    with lift.lock():
        with pytest.raises(JobError, match="it is running") as refused:
            start.resume_lift(scene.plgs, str(lift.path))
        assert refused.value.fix == "Watch it, or cancel it first."
        with pytest.raises(JobError, match="still running"):
            start.show_lift(scene, str(lift.path))
    with pytest.raises(JobError, match="not finished") as refused:
        start.show_lift(scene, str(lift.path))
    assert "Resume" in refused.value.fix
