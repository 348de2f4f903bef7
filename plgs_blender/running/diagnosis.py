"""The problems that an engine finds in a scene, and the corrected scene that it writes."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job import write_atomically
from ...engine.job.follower import TaskFollower
from ...engine.job.own_files import OwnFiles
from .. import registry
from ..chosen_scene import AUTOMATIC, ChosenScene
from ..engine_environment import usable_python
from ..registry import SceneTask, start_engine
from ..settings import PLGS_PG_settings, chosen_scene
from . import looking


@dataclass(frozen=True)
class Finding:
    """A finding of the diagnosis: its ``cause`` in a word or two, a ``text`` with figures, and how to fix it
    (``option``). It is a problem (``is_wrong``), which "Fix" can solve (``is_mended``), or a note. It concerns
    ``frames`` (none: all); a lift is better without those in ``leave_out``."""

    cause: str
    text: str
    option: str
    is_wrong: bool
    is_mended: bool
    frames: tuple[str, ...]
    leave_out: tuple[str, ...]
    picture: Path | None


@dataclass(frozen=True)
class FrameSplit:
    """The content of the splits.json at ``path``: the frames to train on, and the held-out ones."""

    path: Path
    train: tuple[str, ...]
    test: tuple[str, ...]

    def without(self, names: Iterable[str]) -> FrameSplit:
        """Return the split without these frames."""
        gone = {*names}
        train, test = (tuple(name for name in part if name not in gone) for part in (self.train, self.test))
        return FrameSplit(self.path, train, test)

    def has_any(self, names: Iterable[str]) -> bool:
        return not {*names}.isdisjoint((*self.train, *self.test))


class Diagnosis(SceneTask):
    """Measures a scene for problems. ``mended`` is the folder that "Fix" writes; `is_mended` says whether it did."""

    kind, label, cancel_operator = "diagnosis", "Measuring", "plgs.cancel_diagnosis"

    def __init__(self, chosen: ChosenScene, mended: Path | None, folder: Path, follower: TaskFollower) -> None:
        super().__init__(chosen, follower)
        self.mended = mended
        self.findings: tuple[Finding, ...] = ()
        self.looked = self.frames = 0
        self.can_be_mended = False
        self.split: FrameSplit | None = None
        self._folder = folder

    @property
    def is_mended(self) -> bool:
        """Whether the fixed scene was written."""
        return self.is_taken and self.mended is not None and self.mended.is_dir()

    def done(self, scene: Any) -> None:
        if self.answer is not None:  # also of a scene that cannot be lifted: the findings say why
            self._read(self.answer)
        if self.is_mended and not self.was_cancelled:
            assert self.mended is not None
            chosen = {"masks": "", "depth": "", "up": "z", "format": AUTOMATIC, "scene_folder": str(self.mended)}
            for settings in [each.plgs for each in bpy.data.scenes]:
                if settings.scene_folder and chosen_scene(settings) == self.chosen:
                    for name, value in chosen.items():
                        if getattr(settings, name) != value:  # each assignment makes us read the folder
                            setattr(settings, name, value)
            self.undo_step = "PLGS Fix"

    def _read(self, answer: Mapping[str, Any]) -> None:
        """Read the findings in the engine's answer. Raises PlgsError if it has another form."""
        try:
            diagnosis = answer["diagnosis"]
            self.findings = tuple(_finding(entry, self._folder) for entry in diagnosis["findings"])
            self.looked, self.frames = int(diagnosis["looked"]), int(diagnosis["frames"])
            self.can_be_mended = bool(diagnosis["can_be_mended"])
            split = answer["split"]
            self.split = FrameSplit(Path(split["path"]), *(tuple(map(str, split[key])) for key in ("train", "test")))
        except (ValueError, TypeError, KeyError) as fault:
            what = f"the engine's diagnosis cannot be read ({fault!r})"
            raise PlgsError("bad-answer", what, self.chosen.scene, "Diagnose again.") from fault

    def let_go(self) -> None:
        super().let_go()
        shutil.rmtree(self._folder, ignore_errors=True)


def diagnosis_of(chosen: ChosenScene) -> Diagnosis | None:
    """Return the diagnosis of this scene; None if it was not measured or measuring was cancelled."""
    known = registry.latest(Diagnosis)
    return known if known is not None and known.chosen == chosen and not known.was_cancelled else None


def diagnose(settings: PLGS_PG_settings, mended: Path | None = None) -> Diagnosis:
    """Let an engine measure the panel's scene and, if ``mended`` is given, write a corrected copy into that folder.
    Raises PlgsError without an engine."""
    registry.refuse_second(Diagnosis)
    chosen, python = chosen_scene(settings), usable_python()
    folder = Path(tempfile.mkdtemp(prefix="plgs-findings-"))
    arguments = [*chosen.arguments(), "-o", folder]
    arguments += [] if mended is None else ["--fix", mended]
    try:
        follower = start_engine("inspect", python, *arguments)
    except BaseException:  # no task deletes the folder then
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return registry.begin(Diagnosis(chosen, mended, folder, follower))


def leave_out(known: Diagnosis, finding: Finding) -> tuple[Path, Path | None]:
    """Remove a finding's frames from the capture's splits.json; one that PLGS did not write is renamed first. Returns
    the paths of the new file and of the renamed one or None. Raises PlgsError if no training frame is left; OSError."""
    assert known.split is not None
    split = known.split.without(finding.leave_out)
    if not split.train:
        what = "no frame to train on would be left"
        raise PlgsError("no-training-frame", what, split.path, "Leave fewer frames out.")
    with OwnFiles(split.path.parent).begin("split", {}, among_others=True) as own:
        kept = own.set_aside(split.path)
        write_atomically(split.path, json.dumps({"train": split.train, "test": split.test}))
    own.complete()
    known.split = split
    looking.look_at_scene(known.chosen)
    return split.path, kept


def _finding(entry: Mapping[str, Any], folder: Path) -> Finding:
    picture = entry.get("picture")
    return Finding(
        cause=str(entry["cause"]),
        text=str(entry["text"]),
        option=str(entry["option"]),
        is_wrong=entry["severity"] == "wrong",
        is_mended=bool(entry["is_mended"]),
        frames=tuple(map(str, entry["frames"])),
        leave_out=tuple(map(str, entry["leave_out"])),
        picture=None if picture is None else folder / str(picture),
    )
