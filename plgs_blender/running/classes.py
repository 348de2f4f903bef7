"""An engine that lists the classes of a scene's masks, and writes the list that was edited."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ..chosen_scene import ChosenScene
from ..engine_environment import usable_python
from ..mask_classes import OWN_TABLE, edited_classes, fill_classes
from ..settings import chosen_scene
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine
from . import looking


class ClassListing(Task):
    """The list goes into the rows of the scene called ``target``; after writing, the panel looks at the masks again."""

    kind, label = "classes", "Reading the classes"
    undo_step = "PLGS Read Classes"

    def __init__(self, chosen: ChosenScene, target: str, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.chosen, self._target = chosen, target

    def done(self, scene: Any) -> None:
        target = bpy.data.scenes.get(self._target)
        if self.answer is None or target is None:
            return
        try:
            fill_classes(target.plgs_masks, self.answer)
        except (ValueError, TypeError, KeyError) as fault:
            what = f"the engine's list is not understood ({fault!r})"
            raise PlgsError(what, self.chosen.scene, "Read the classes again.") from fault


class ClassWriting(Task):
    """Writes classes.toml."""

    kind, label = "write_classes", "Writing the classes"

    def __init__(self, chosen: ChosenScene, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.chosen = chosen
        self.message = ""

    def done(self, scene: Any) -> None:
        if self.answer is not None:
            self.message = f"Classes written to {self.answer.get('path')}"
            looking.look_at_scene(self.chosen)


def read_classes(scene: bpy.types.Scene, table: str = OWN_TABLE) -> ClassListing:
    """Let an engine list the classes of the panel's scene. Raises PlgsError, OSError."""
    registry.refuse_second(ClassListing)
    chosen = chosen_scene(scene.plgs)
    more = [] if table == OWN_TABLE else ["--table", table]
    follower = start_engine("classes", usable_python(), *chosen.arguments(), *more)
    return timer.begin(ClassListing(chosen, scene.name, follower))


def write_classes(scene: bpy.types.Scene) -> ClassWriting:
    """Let an engine write the rows into the classes.toml beside the masks. Raises PlgsError, OSError."""
    registry.refuse_second(ClassWriting)
    chosen = chosen_scene(scene.plgs)
    edited = json.dumps(edited_classes(scene.plgs_masks))
    path = Path(bpy.app.tempdir) / "plgs-classes.json"
    path.write_text(edited, encoding="utf-8")
    follower = start_engine("classes", usable_python(), *chosen.arguments(), "--write", path)
    return timer.begin(ClassWriting(chosen, follower))
