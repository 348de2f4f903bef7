"""An engine that finds the poses of photos or of a film."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ..chosen_scene import ChosenScene
from ..settings import chosen_scene
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine
from . import looking


class PoseMaking(Task):
    """The panel takes the scene that it made. When it is cancelled nothing is written."""

    kind, label, cancel_operator = "poses", "Finding poses", "plgs.cancel_poses"

    def __init__(self, chosen: ChosenScene, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.chosen = chosen

    @property
    def message(self) -> str:
        """What it made; empty before."""
        made = self.answer or {}
        return f"Poses of {made['posed']} of {made['photos']} photos" if "posed" in made else ""

    def done(self, scene: Any) -> None:
        settings = scene.plgs
        if not self.has_finished or not settings.scene_folder or chosen_scene(settings) != self.chosen:
            return
        settings.scene_folder = str(Path((self.answer or {}).get("folder", self.chosen.scene)))
        looking.look_at_scene(chosen_scene(settings))

    def error_for(self, chosen: ChosenScene) -> PlgsError | None:
        """Its error, where it is of this scene."""
        return self.error if chosen == self.chosen else None


def make_poses(chosen: ChosenScene, python: Path) -> PoseMaking:
    """Start an engine. Raises PlgsError when one is at it already or cannot be started, OSError."""
    registry.refuse_second(PoseMaking)
    return timer.begin(PoseMaking(chosen, start_engine("poses", python, chosen.scene)))
