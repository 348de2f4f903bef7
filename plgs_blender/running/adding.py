"""Find out which packages the engine lacks for a capability, and add them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ...engine.job.handshake import ADDED, CAPABILITIES
from .. import registry
from ..engine_environment import status, tasks
from ..engine_environment.choices import set_up_choice
from ..registry import Task, start_engine
from ..settings import chosen_scene
from . import looking
from .survey import survey_of

ITEMS = [(name, CAPABILITIES[name].label, ", ".join(CAPABILITIES[name].packages)) for name in ADDED]


class Adding(Task):
    """A task that adds packages to the engine. After a cancel or a failure, the engine is unchanged."""

    kind, label, cancel_operator = "add", "Adding to the engine", "plgs.cancel_adding"
    counts_steps = False

    def __init__(self, name: str, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.name = name
        self.message = f"{CAPABILITIES[name].label}: added to the engine"

    def done(self, scene: Any) -> None:
        if not self.has_finished:
            return
        tasks.check()
        chosen = chosen_scene(scene.plgs) if scene.plgs.scene_folder else None
        if chosen is not None and (survey := survey_of(chosen)) is not None and survey.error is not None:
            looking.look_at_scene(chosen)


def lacking(name: str) -> tuple[str, ...]:
    """The packages missing for one of `CAPABILITIES`, as far as the engine has answered. Never reads the disk."""
    answer = status().answer
    return () if answer is None else answer.capabilities.get(name, ())


def why_lacking(name: str) -> str | None:
    """Return why the engine lacks a capability; None if the engine has it or has not answered yet."""
    packages = lacking(name)
    label = CAPABILITIES[name].label
    return f"{label}: the engine lacks {', '.join(packages)}. Add it to the engine" if packages else None


def size_of(name: str) -> int:
    """Return roughly how many bytes on disk the packages of a capability take."""
    return CAPABILITIES[name].size


def why_not_added() -> str | None:
    """Return why nothing can be added now, None if packages can. Never reads the disk."""
    return "Something is already being added to the engine" if registry.running(Adding) else tasks.why_no_set_up()


def add(name: str, python: Path, index_url: str = "") -> Adding:
    """Start adding packages for one of `ADDED` to ``python``'s environment. Raises PlgsError if refused; OSError."""
    reason = why_not_added()
    if reason is not None:
        raise PlgsError("adding-refused", "nothing can be added to the engine now", CAPABILITIES[name].label, reason)
    variables = set_up_choice(index_url=index_url).variables()
    return registry.begin(Adding(name, start_engine("add", python, name, variables=variables)))
