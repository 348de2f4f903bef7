"""The corrections of an earlier result in a new one: which it takes over, and what replaces removed objects there. That
was computed for the earlier result, so each lift makes it anew, and keeps the earlier one only where it cannot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress

from ..corrections import CorrectedResult, Edit, MadeResult, editing, read_corrected, read_edits
from ..corrections.fills import path_of, read_fill, write_fill
from ..errors import PlgsError
from ..job import EventWriter, LiftFolder
from ..job.progress import Progress, StageReporter
from ..posed.layout import plural
from .baking import FrameBaker
from .lasting_names import EarlierLift

FILL = "fill"
"""The stage in which fills are made."""
BakerOf = Callable[[CorrectedResult], FrameBaker]
MakeFills = Callable[[LiftFolder, Sequence[Edit], BakerOf, Progress], Mapping[str, str]]
"""Makes the fills of the removals among edits for the new result of a folder. Returns, by uid, why one cannot be made.
`plates.make_fills` is one."""


def kept_edits(own: Iterable[Edit], earlier: EarlierLift | None) -> tuple[Edit, ...]:
    """Return a lift's ``own`` edits, and those of an ``earlier`` lift that it takes over, in their order."""
    own = tuple(own)
    known = {edit.uid for edit in own}
    taken = () if earlier is None else earlier.edits
    return (*own, *(edit for edit in taken if not edit.undone and edit.uid not in known))


def removals(edits: Iterable[Edit]) -> list[Edit]:
    """Return the edits that remove objects, and are not undone."""
    return [edit for edit in edits if edit.kind == "remove" and not edit.undone]


def with_own_fills(
    made: LiftFolder, edits: Sequence[Edit], earlier: EarlierLift | None, stages: StageReporter,
    make_fills: Callable[[Progress], Mapping[str, str]],
) -> tuple[CorrectedResult | None, dict[str, str]]:  # fmt: skip
    """Give the new result that is ``made`` fills of its own for the removals among ``edits``: those that ``make_fills``
    makes, else the earlier ones. Returns the result after the edits, None without any; and, by uid, why an edit's fill
    could not be made, or "". Raises OSError; PlgsError for bad files; Cancelled."""
    if not edits:
        return None, {}
    lifts = dict.fromkeys([*([] if earlier is None else [earlier.folder]), made.path])  # the latter counts
    for edit, lift in ((edit, lift) for edit in removals(edits) for lift in lifts):
        own = path_of(lift / LiftFolder.result_name, edit.fill)
        with suppress(PlgsError):  # a missing or damaged one is not taken
            fill = read_fill(own) if own.is_file() else read_fill(path_of(lift, edit.fill), edit.digest)
            write_fill(path_of(made.result_path, edit.fill), fill)
    not_made: Mapping[str, str] = {}
    if removals(edits):
        with stages.stage(FILL) as progress:
            not_made = make_fills(progress)
    corrected = MadeResult.read(made.path, name=made.result_name).corrected(edits)
    return corrected, {edit.uid: not_made.get(edit.uid, "") for edit in edits}


def take_over_edits(folder: LiftFolder, earlier: EarlierLift) -> None:
    """Copy the earlier lift's corrections to this lift, in which the same objects have the same ids. Corrections that
    no longer apply are kept, too. Raises PlgsError if corrections cannot be read, and OSError."""
    if earlier.edits:
        with editing(folder.path) as edits:
            edits[:] = kept_edits(edits, earlier)


def drop_fills_of_undone(folder: LiftFolder) -> None:
    """Delete the fills of undone removals, which fit an earlier result: a redo then says that they are missing. Raises
    OSError; PlgsError for bad files."""
    edits = read_edits(folder.path)
    used = {edit.fill for edit in removals(edits)}
    for edit in edits:
        if edit.kind == "remove" and edit.fill not in used:
            path_of(folder.path, edit.fill).unlink(missing_ok=True)


def report_edits(
    folder: LiftFolder, earlier: EarlierLift | None, filled: Mapping[str, str], events: EventWriter
) -> None:
    """Warn of the corrections that do not apply to a new result, and of removals whose fill is of an earlier result.
    ``filled`` has, by uid, why no new fill could be made, "" if it was; edits made since then are not in it. Raises
    PlgsError for bad files."""
    if not read_edits(folder.path):
        return
    corrected = read_corrected(folder.path)
    lines = list(corrected.warnings)
    if any(edit.uid in corrected.not_applied for edit in removals(corrected.edits)):
        lines.append("what is not removed here shows again: remove it by its present name")
    names = {one.id: one.name for one in corrected.removed}
    for edit in removals(corrected.edits):
        why = filled.get(edit.uid, "it was removed while the lift ran")
        if why and edit.uid not in corrected.not_applied:
            away = ", ".join(names[mark.id] for mark in edit.objects)
            lines.append(
                f"what stands in place of {away} was made for the earlier result, and remains of it may show, as "
                f"{why}: put it back, and remove or delete it again"
            )
    if earlier is not None and earlier.edits:
        applied = sum(not edit.undone and edit.uid not in corrected.not_applied for edit in corrected.edits)
        some = "correction of the earlier lift applies", "corrections of the earlier lift apply"
        lines.append(f"{plural(applied, *some)} here")
    for line in lines:
        events.warning(line)
