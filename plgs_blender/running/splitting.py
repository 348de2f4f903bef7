"""Splitting an object by the views that separate it: an engine reads the masks, and makes the edit."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import bpy

from ...engine.corrections import Edit, read_corrected, read_edits
from ...engine.job.follower import TaskFollower
from .. import corrections, engine_environment
from ..errors import plural
from ..lift_collection import FOLDER, folder_of, is_same_place, lifts_in
from ..owned import text_of
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine


class SplitByViews(Task):
    """The split of one object of a placed lift. The edit is in the lift's file when it is done, and then shown."""

    kind, label, cancel_operator = "split", "Reading the masks", "plgs.cancel_split"

    def __init__(self, lift: Path, follower: TaskFollower, known: Collection[str]) -> None:
        """``known``: the uids of the edits before it."""
        super().__init__(follower)
        self._lift, self._known = lift, known
        self._edit: Edit | None = None

    @property
    def has_finished(self) -> bool:
        """Whether the edit was made: an engine may be stopped between writing it and its answer."""
        return self._edit is not None

    @property
    def was_cancelled(self) -> bool:
        return super().was_cancelled and not self.has_finished

    @property
    def message(self) -> str:
        """One line about what it made."""
        if self.was_cancelled:
            return "The split was cancelled"
        return plural(0 if self._edit is None else len(self._edit.made), "new object")

    def done(self, scene: Any) -> None:
        made = [edit for edit in read_edits(self._lift) if edit.uid not in self._known and edit.kind == "split"]
        self._edit = made[-1] if made else None
        every = {root for each in bpy.data.scenes for root in lifts_in(each)}
        shown = [root for root in every if is_same_place(text_of(root, FOLDER), self._lift)]
        if self._edit is None or not shown:
            return
        result = read_corrected(self._lift)
        for root in shown:
            corrections.show_edit(root, self._edit.uid, result)
        self.undo_step = "Split by Views"


def split_by_views(root: bpy.types.Collection, instance: int) -> SplitByViews:
    """Start to split an object of a placed lift into the parts that the masks separate. Raises PlgsError, OSError."""
    registry.refuse_second(SplitByViews)
    lift, python = folder_of(root), engine_environment.usable_python()
    known = {edit.uid for edit in read_edits(lift)}
    follower = start_engine("correct", python, lift, "split", str(instance), "--views")
    return timer.begin(SplitByViews(lift, follower, known))
