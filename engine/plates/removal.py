"""Remove objects from a finished lift, from end to end."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..corrections import CorrectedResult, Edit, MadeResult, correct, making
from ..corrections.edits import CORRECTIONS, read_edits
from ..corrections.fills import FILLS, Fill, path_of, read_fill, write_fill
from ..corrections.replay import Replay
from ..errors import ErrorCode, PlgsError
from ..job import LiftFolder, read_manifest
from ..job.progress import Progress, part_of, unwatched
from ..lift.baking import FrameBaker, read_baker, voted_labels
from ..lift.kept_corrections import BakerOf, removals
from ..lift.scene_files import MODEL
from ..machine.code_digest import code_digest
from ..model.settling import gaussian_centres
from ..posed.layout import listed
from ..scene_of_lift import names_of_frames, scene_of_lift
from .completion import complete
from .fill import cleared_cells, gaussians_of, joined, replaced_gaussians
from .leaving import leaving_gaussians, leaving_points, other_points, with_legs
from .planes import ON_PLANE, Plane, find_planes
from .remains import remains_of
from .texture import texture_around
from .views import PlateView, frames_around, read_views

UNUSED = 4
"""The most fills that stay though no correction needs them: those of the newest plates, for more of their frames."""
TOGETHER = 0.5
"""Metres between the boxes of objects that are removed together."""
READ = 0.7
"""The share of the time that the photos take."""


Tell = Callable[[str], object]
"""Takes a line for a person about what a removal leaves undone."""


def untold(line: str) -> None:
    """Tell nobody."""


def remove(
    folder: LiftFolder, objects: Sequence[str], progress: Progress = unwatched, tell: Tell = untold
) -> tuple[Edit, CorrectedResult]:
    """Take objects, given by ids or names, out of a finished lift, by an edit like any other. Returns the edit and the
    new result. Raises PlgsError if there is no such object, if the scene is gone, and if the lift is corrected or made
    anew meanwhile; OSError, and what ``progress`` raises. Nothing is then changed."""
    known = read_edits(folder.path), _model_of(folder)
    edit, _ = _removal(folder, objects, progress, tell)

    def make(state: Replay, _: int) -> Edit:
        if (read_edits(folder.path), _model_of(folder)) != known:
            what = "the lift was corrected, or made anew, in the meantime"
            raise PlgsError("corrected-meanwhile", what, folder.path / CORRECTIONS, "Try again.", code=ErrorCode.BUSY)
        return edit

    return correct(folder.path, make)


def without(
    folder: LiftFolder, objects: Sequence[str], progress: Progress = unwatched, tell: Tell = untold
) -> CorrectedResult:
    """Return the corrected result without objects, as `remove` makes it, but save no edit. Raises like `remove`."""
    return _removal(folder, objects, progress, tell)[1]


def _model_of(folder: LiftFolder) -> str:
    """Return the SHA-256 of the result's model. Raises PlgsError if the lift is not finished."""
    return next((file.sha256 for file in read_manifest(folder.result_path).files if str(file.path) == MODEL), "")


def _removal(
    folder: LiftFolder, objects: Sequence[str], progress: Progress, tell: Tell
) -> tuple[Edit, CorrectedResult]:
    """Return the edit that removes the objects, and the result after it. Write the edit's fill to a file if need be."""
    folder.refuse_read_only()
    result, edits = MadeResult.read(folder.path), read_edits(folder.path)
    state = result.replay(edits)
    corrected = result.corrected(edits, state)
    ids = sorted({making.object_of(state, each) for each in objects})
    lost = [edit for edit in edits if edit.kind == "remove" and edit.uid in corrected.not_applied]
    for edit in lost:
        if not {mark.id for mark in edit.objects}.isdisjoint(ids):
            what = f"these objects were removed before, but {corrected.not_applied[edit.uid]}"
            raise PlgsError("removal-lost", what, folder.path / CORRECTIONS, "Put them back, then remove them again.")
    decides = ids, corrected.fingerprint, _model_of(folder), code_digest("engine")
    name = sha256(repr(decides).encode()).hexdigest()[:16]
    path, views, baker_of = path_of(folder.path, name), list[PlateView](), partial(read_baker, folder, result.classes)
    try:
        read_fill(path)
        digest = sha256(path.read_bytes()).hexdigest()
    except PlgsError:  # there is none, or a damaged one
        fill, views = fill_of(folder, result, edits, ids, baker_of=baker_of, progress=progress, tell=tell)
        digest = write_fill(path, fill)
        _drop_unused(folder.path)
    edit = making.remove(state, ids, name, digest)
    after = result.corrected([*edits, replace(edit, uid=edit.fill)])  # the same plate has the same uid
    for line in remains_of(corrected, after, ids, baker_of(after) if views else None, views):
        tell(line)
    return edit, after


def _drop_unused(lift: Path) -> None:
    """Delete the fills that no edit needs, not even an undone one. The ``UNUSED`` newest of these are kept."""
    fills = [path for path in (lift / FILLS).glob("*.npz") if re.fullmatch("[0-9a-f]{16}", path.stem)]
    used = {edit.fill for edit in read_edits(lift)}  # read again: another process may have added an edit
    with suppress(OSError):  # another process deletes it too, or has it open: no reason to fail
        for path in sorted((path for path in fills if path.stem not in used), key=os.path.getmtime)[:-UNUSED]:
            path.unlink()


def make_fills(folder: LiftFolder, edits: Sequence[Edit], baker_of: BakerOf, progress: Progress) -> dict[str, str]:
    """Make the fills of all removals among ``edits`` for a new result, in its folder, each as `remove` makes it after
    the edits before it. ``baker_of`` returns a baker of a corrected result. Returns, by uid, why one cannot be made.
    Raises OSError, and what ``progress`` raises."""
    result, failed = MadeResult.read(folder.path, name=folder.result_name), dict[str, str]()
    wanted = removals(edits)
    for done, edit in enumerate(wanted):
        before, ids = edits[: edits.index(edit)], [mark.id for mark in edit.objects]
        if any(map(result.replay(before).missing, edit.objects)):
            continue  # the edit does not apply, as the corrected result says
        part = part_of(progress, done / len(wanted), (done + 1) / len(wanted), 100)
        try:
            fill, _ = fill_of(folder, result, before, ids, baker_of=baker_of, progress=part)
        except PlgsError as error:
            failed[edit.uid] = error.what
        else:
            write_fill(path_of(folder.result_path, edit.fill), fill)
    return failed


def fill_of(
    folder: LiftFolder, result: MadeResult, edits: Sequence[Edit], ids: Sequence[int], *,
    baker_of: BakerOf, progress: Progress, tell: Tell = untold,
) -> tuple[Fill, list[PlateView]]:  # fmt: skip
    """Return what replaces objects ``ids`` of a ``result`` after ``edits``, and the photos around them. Raises
    PlgsError for unreadable photos, and what ``progress`` raises."""
    corrected = result.corrected(edits)
    baker = baker_of(corrected)
    points = {number: corrected.points.xyz[corrected.points.instance_id == number] for number in ids}
    points = {number: xyz for number, xyz in points.items() if len(xyz)}
    if not points:
        what = "no point of the lift belongs to these objects"
        raise PlgsError("remove-no-points", what, folder.path, "Delete them instead.")
    room, scene = _Room(baker, corrected, ids), scene_of_lift(folder)
    if lost := {*names_of_frames(folder)} - {frame.name for frame in scene.frames}:
        tell(f"the scene no longer has frame {listed(sorted(lost))}: what only it showed is guessed")
    frames = frames_around(scene.train_frames, np.concatenate([*points.values()]))
    away, as_in_photos = corrected.removed, baker
    if away:  # the photos still show these, which no label says once they are removed
        there = [replace(edit, undone=edit.undone or edit.kind == "remove") for edit in edits]
        as_in_photos = baker_of(result.corrected(there))
    absent = {*ids, *(one.id for one in away)}
    views = list(read_views(frames, as_in_photos, absent, part_of(progress, 0.0, READ, 100)))
    groups, parts = _groups([*points.values()]), list[Fill]()
    for number, xyz in enumerate(groups):
        begin, end = (READ + (1 - READ) * done / len(groups) for done in (number, number + 1))
        parts.append(room.without(views, xyz, part_of(progress, begin, end, 100)))
    progress(1, 1)
    return joined(parts), views


def _groups(points: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    """Join the points [N, 3] of objects whose boxes are near each other. Returns the points of each group."""
    groups: list[NDArray[np.float32]] = []
    for xyz in points:
        apart = []
        for other in groups:
            gap = np.maximum(xyz.min(axis=0) - other.max(axis=0), other.min(axis=0) - xyz.max(axis=0)).max()
            if gap < TOGETHER:
                xyz = np.concatenate([xyz, other])
            else:
                apart.append(other)
        groups = [*apart, xyz]
    return groups


class _Room:
    """A lift's Gaussians and the objects that stay in the room, when those with these ``ids`` are removed."""

    def __init__(self, baker: FrameBaker, corrected: CorrectedResult, ids: Sequence[int]) -> None:
        scene = baker.lifted
        voted = voted_labels(scene, corrected)
        codes = np.array([*(-one for one in scene.channels.class_ids), *scene.channels.shown_ids], np.int32)
        label = codes[voted.label.numpy().astype(np.int64)]
        share = np.where(np.isin(label, sorted(ids)), voted.share.numpy(), 0).sum(axis=1)
        centres, drawn = gaussian_centres(scene.anchors), np.ones(len(label), np.bool_)
        if scene.fill is not None:
            centres = np.concatenate([centres, scene.fill.means.numpy()])
            drawn[: len(scene.fill.gone)] = ~scene.fill.gone.numpy()
        self.things, self.label = corrected.classes.thing_ids, label[drawn, 0]
        others = corrected.points.instance_id > 0
        self.staying = corrected.points.xyz[others & ~np.isin(corrected.points.instance_id, ids)]
        self.centres, self.share = centres[drawn].astype(np.float64), share[drawn]

    def without(self, views: Sequence[PlateView], points: NDArray[np.floating], progress: Progress) -> Fill:
        """Return what replaces the objects that have these ``points`` [N, 3]."""
        leaving = leaving_points(views, points)
        others = other_points(views, leaving)
        progress(1, 10)
        planes = find_planes(others.xyz, others.towards)
        views, leaving, others = with_legs(views, leaving, others, planes)
        progress(3, 10)
        gone = leaving_gaussians(self.centres, self.label, self.share, leaving, others)
        parts = list[Fill]()
        for number, plane in enumerate(planes):
            progress(4 + 6 * number // len(planes), 10)
            solid = [one for one in planes if one is not plane and self._is_stuff(one, others.xyz, others.label)]
            texture = texture_around(plane, solid, views, leaving)
            progress(4 + (6 * number + 3) // len(planes), 10)  # a second or more each
            completed = texture and complete(texture, leaving, self.staying)
            if texture is not None and completed:
                parts.append(gaussians_of(texture, completed))
                gone |= replaced_gaussians(self.centres, self.label, texture, completed, others)
        fill = joined(parts)
        replaced = (self.label <= 0) | np.isin(self.label, fill.label)
        return replace(fill, cells=cleared_cells(self.centres, gone & replaced, ~gone & replaced))

    def _is_stuff(self, plane: Plane, xyz: NDArray[np.floating], label: NDArray[np.int32]) -> bool:
        on = np.abs(plane.local(xyz)[:, 2]) < ON_PLANE
        return bool(((label[on] < 0) & ~np.isin(-label[on], sorted(self.things))).mean() > 0.5)
