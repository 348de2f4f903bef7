"""Engines that prepare a scene for its lift: one makes masks, one finds the poses of photos or of a film."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ..chosen_scene import ChosenScene
from ..paths import absolute
from ..settings import chosen_scene
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine
from . import looking


class Preparation(Task):
    """When it has finished, the panel looks at the scene again, if it is still the chosen one."""

    def __init__(self, chosen: ChosenScene, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.chosen = chosen

    def done(self, scene: Any) -> None:
        settings = scene.plgs
        if self.has_finished and settings.scene_folder and chosen_scene(settings) == self.chosen:
            self.take_scene(settings)
            looking.look_at_scene(chosen_scene(settings))

    def take_scene(self, settings: Any) -> None:
        """Put the scene that it made, if it made one, into the settings."""

    def error_for(self, chosen: ChosenScene) -> PlgsError | None:
        """Its error, if it concerns this scene."""
        return self.error if chosen == self.chosen else None


class MaskMaking(Preparation):
    """What it made is kept when it is cancelled, and the next one continues."""

    kind, label, cancel_operator = "masks", "Making masks", "plgs.cancel_masks"


class PoseMaking(Preparation):
    """The panel takes the scene that it made. When it is cancelled nothing is written."""

    kind, label, cancel_operator = "poses", "Finding poses", "plgs.cancel_poses"

    @property
    def message(self) -> str:
        """What it made; empty before."""
        made = self.answer or {}
        return f"Poses of {made['posed']} of {made['photos']} photos" if "posed" in made else ""

    def take_scene(self, settings: Any) -> None:
        settings.scene_folder = str(Path((self.answer or {}).get("folder", self.chosen.scene)))


def make_masks(chosen: ChosenScene, python: Path, model: str, *, download: bool) -> MaskMaking:
    """Start an engine. ``model`` is a folder or a name on Hugging Face's hub; empty leaves it to the engine.
    ``download`` lets it fetch that. Raises PlgsError when one is already running or cannot be started, OSError.
    """
    registry.refuse_second(MaskMaking)
    if model and absolute(model).is_dir():  # the engine's working folder is not Blender's
        model = str(absolute(model))
    command: list[str | Path] = [chosen.scene, f"--up={chosen.up_option}"]
    command += [] if chosen.scene_format is None else ["--format", chosen.scene_format]
    command += [*(["--model", model] if model else []), *(["--download"] if download else [])]
    return timer.begin(MaskMaking(chosen, start_engine("segment", python, *command)))


def make_poses(chosen: ChosenScene, python: Path) -> PoseMaking:
    """Start an engine. Raises PlgsError when one is already running or cannot be started, OSError."""
    registry.refuse_second(PoseMaking)
    return timer.begin(PoseMaking(chosen, start_engine("poses", python, chosen.scene)))
