"""What is wrong with a scene, as an engine measures it, and the fixed scene that it writes.

The panel draws from here.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ..chosen_scene import ChosenScene
from ..engine_environment import usable_python
from ..scene_formats import AUTOMATIC
from ..settings import PLGS_PG_settings, chosen_scene
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine


@dataclass(frozen=True)
class Finding:
    """One finding: its ``cause`` in a word or two, what is wrong, with figures, what fixes it, and its picture.

    When it ``is_wrong`` it should be fixed before a lift; else it is a note. When it ``is_mended``, "Fix" fixes it.
    """

    cause: str
    text: str
    option: str
    is_wrong: bool
    is_mended: bool
    picture: Path | None


class Diagnosis(Task):
    """Measures what is wrong with a scene. There are no findings before its end; if there are none afterwards, its
    error says why. ``mended`` is the folder that "Fix" writes, and `is_mended` says whether it did.
    """

    kind, label, cancel_operator = "diagnosis", "Measuring", "plgs.cancel_diagnosis"

    def __init__(self, chosen: ChosenScene, mended: Path | None, folder: Path, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.chosen, self.mended = chosen, mended
        self.findings: tuple[Finding, ...] = ()
        self.looked = self.frames = 0
        self.can_be_mended = False
        self._folder = folder

    @property
    def is_mended(self) -> bool:
        """Whether the fixed scene was written."""
        return self.is_taken and self.mended is not None and self.mended.is_dir()

    def done(self, scene: Any) -> None:
        """A scene that a lift refuses has findings too, which say why."""
        if self.answer is not None:
            self._read(self.answer)
        if self.is_mended and not self.was_cancelled:
            assert self.mended is not None
            for each in bpy.data.scenes:
                if each.plgs.scene_folder and chosen_scene(each.plgs) == self.chosen:
                    _choose_mended(each.plgs, self.mended)
            self.undo_step = "PLGS Fix"

    def _read(self, answer: Mapping[str, Any]) -> None:
        """Raises PlgsError."""
        try:
            told = answer["diagnosis"]
            self.findings = tuple(_finding(entry, self._folder) for entry in told["findings"])
            self.looked, self.frames = int(told["looked"]), int(told["frames"])
            self.can_be_mended = bool(told["can_be_mended"])
        except (ValueError, TypeError, KeyError) as fault:
            what = f"the engine's findings are not understood ({fault!r})"
            raise PlgsError(what, self.chosen.scene, "Diagnose again.") from fault

    def let_go(self) -> None:
        super().let_go()
        shutil.rmtree(self._folder, ignore_errors=True)


def diagnosis_of(chosen: ChosenScene) -> Diagnosis | None:
    """What is known about this scene; None when it was not measured, or measuring was cancelled."""
    known = registry.latest(Diagnosis)
    return known if known is not None and known.chosen == chosen and not known.was_cancelled else None


def diagnose(settings: PLGS_PG_settings, mended: Path | None = None) -> Diagnosis:
    """Let an engine measure the panel's scene, and with ``mended`` write it there with all safe fixes.

    Raises PlgsError when no engine can be started, OSError.
    """
    registry.refuse_second(Diagnosis)
    chosen, python = chosen_scene(settings), usable_python()
    folder = Path(tempfile.mkdtemp(prefix="plgs-findings-"))
    arguments = [*chosen.arguments(), "-o", folder]
    arguments += [] if mended is None else ["--fix", mended]
    try:
        follower = start_engine("inspect", python, *arguments)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return timer.begin(Diagnosis(chosen, mended, folder, follower))


def _choose_mended(settings: PLGS_PG_settings, mended: Path) -> None:
    """Let the panel show the fixed scene, which contains its masks and has its z axis up.

    Each assignment makes us look at the folder, so only what differs is assigned, and the folder last.
    """
    values = {"masks": "", "depth": "", "up": "z", "format": AUTOMATIC, "scene_folder": str(mended)}
    for name, value in values.items():
        if getattr(settings, name) != value:
            setattr(settings, name, value)


def _finding(entry: Mapping[str, Any], folder: Path) -> Finding:
    picture = entry.get("picture")
    return Finding(
        cause=str(entry["cause"]),
        text=str(entry["text"]),
        option=str(entry["option"]),
        is_wrong=entry["severity"] == "wrong",
        is_mended=bool(entry["is_mended"]),
        picture=None if picture is None else folder / str(picture),
    )
