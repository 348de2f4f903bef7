"""The command `correct`: edits of a finished lift, for scripts and farms."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..gates import shortened
from ..job import EventWriter, LiftFolder, StopSignal, read_manifest

if TYPE_CHECKING:
    from ..corrections import CorrectedResult, Edit
    from ..corrections.replay import Replay
    from ..lift.separating import PartsSeen

_LONGEST = 60  # characters of a name in a line
AddTask = Callable[[argparse.ArgumentParser, Callable[[argparse.Namespace, EventWriter, StopSignal], object]], None]


def add_correct(parser: argparse.ArgumentParser, make_task: AddTask) -> None:
    """Add a subcommand, with its arguments, for each kind of edit."""
    parser.description = (
        "Mend what a lift got wrong, without training. Edits are kept in LIFT/corrections.json; result/ stays as the "
        "engine made it. bake, export, evaluate and Blender show the lift with its corrections."
    )
    parser.add_argument("lift", type=Path, metavar="LIFT", help="the folder of a finished lift")
    known = parser.add_subparsers(dest="edit", required=True, metavar="EDIT")
    one = "id or name of the object, as shown by list"
    rename = known.add_parser("rename", help="give an object another name")
    rename.add_argument("id", metavar="OBJECT", help=one)
    rename.add_argument("name", metavar="NAME", help="the name")
    reclass = known.add_parser("reclass", help="give objects another class; with a stuff class they become stuff")
    reclass.add_argument("id", nargs="+", metavar="OBJECT", help=one)
    reclass.add_argument("class_name", metavar="CLASS", help="a class's name, or its id, or both: '3 chair'")
    merge = known.add_parser("merge", help="join objects into one, with the name and the class of the first")
    merge.add_argument("id", nargs="+", metavar="OBJECT", help=one)
    delete = known.add_parser("delete", help="delete a false object: its points join what surrounds them")
    delete.add_argument("id", metavar="OBJECT", help=one)
    delete.add_argument("--no-object", action="store_true", help="keep the points' class, but remove the object")
    split = known.add_parser("split", help="split an object into several")
    split.add_argument("id", metavar="OBJECT", help=one)
    how = split.add_mutually_exclusive_group(required=True)
    how.add_argument("--parts", action="store_true", help="into its connected parts; the largest keeps the id")
    how.add_argument("--views", action="store_true", help="into what the masks of two or more frames separate")
    how.add_argument(
        "--plane", type=float, nargs=6, metavar=("X", "Y", "Z", "NX", "NY", "NZ"),
        help="by the plane through a point in metres; the part in the direction of the normal is the new object",
    )  # fmt: skip
    remove = known.add_parser("remove", help="take objects out of the room: what is behind them is drawn instead")
    remove.add_argument("id", nargs="+", metavar="OBJECT", help=one)
    put_back = known.add_parser("put-back", help="undo the removal of objects, and of those removed together with them")
    put_back.add_argument("id", nargs="+", metavar="OBJECT", help=one)
    accept = known.add_parser("accept", help="mark objects as right: no proposal mentions them again")
    accept.add_argument("id", nargs="+", metavar="OBJECT", help=one)
    undo = known.add_parser("undo", help="undo the last edit")
    listed = known.add_parser("list", help="list the objects with their corrections, and all edits")
    proposed = known.add_parser("propose", help="list what may be wrong, the most doubtful first, and your progress")
    for each in (rename, reclass, merge, delete, remove, put_back, split, accept, undo, listed, proposed):
        make_task(each, correct)


def correct(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    """Do what ``options.edit`` names: make an edit and answer with it, undo one, or list the edits or proposals."""
    from ..corrections import correct, proposals_of, put_back, read_corrected, undo
    from ..job.progress import StageProgress

    folder = LiftFolder.open(options.lift)
    read_manifest(folder.result_path)  # refuses an unfinished lift
    if options.edit == "list":
        corrected = read_corrected(folder.path)
        events.answer(_content(corrected), _listing(corrected))
        return
    if options.edit == "propose":
        found = proposals_of(read_corrected(folder.path))
        lines = [f"{one.instance:5}  {one.name}: {one.reason}; {one.answer}? ({one.frame})" for one in found.open]
        answer = {"looked_at": found.looked_at, "all": found.all, "open": [asdict(one) for one in found.open]}
        events.answer(answer, "\n".join([*lines, found.progress]))
        return

    folder.refuse_read_only()  # before an edit is computed, which may take minutes
    if options.edit == "undo":
        edit, corrected = undo(folder.path)
    elif options.edit == "put-back":
        edit, corrected = put_back(folder.path, options.id)
    elif options.edit == "remove":
        from ..plates import remove

        events.stage("remove", 1, 1, "Removing objects")
        edit, corrected = remove(folder, options.id, StageProgress("remove", events, stop), events.warning)
    else:
        seen = _parts_seen(options, folder, StageProgress("split", events, stop))
        edit, corrected = correct(folder.path, partial(_edit, options, folder, seen))
    for line in corrected.warnings:
        events.warning(line)
    answer = {"uid": edit.uid, "kind": edit.kind, "undone": edit.undone, "made": [one.id for one in edit.made]}
    events.answer(answer, _described(edit, corrected))


def _parts_seen(
    options: argparse.Namespace, folder: LiftFolder, progress: Callable[[int, int], object]
) -> PartsSeen | None:
    """Return the parts of an object that the masks show if the edit is a split by views, else None. Masks are read
    before the edits are locked, as this takes long."""
    if options.edit != "split" or not options.views:
        return None
    from ..corrections import making, replayed
    from ..lift.separating import parts_seen

    state = replayed(folder.path)
    return parts_seen(folder, state, making.object_of(state, options.id), progress)


def _edit(
    options: argparse.Namespace, folder: LiftFolder, seen: PartsSeen | None, state: Replay, first_id: int
) -> Edit:
    """Make the edit of objects in ``state`` that the options ask for. ``seen`` are the parts for a split by views, else
    None; ``first_id`` is the first unused id. Raises PlgsError for an edit that makes no sense."""
    from ..corrections import class_of_parts, making

    named = [options.id] if isinstance(options.id, str) else options.id
    one, *_ = numbers = [making.object_of(state, each) for each in named]
    match options.edit:
        case "rename":
            return making.rename(state, one, options.name)
        case "reclass":
            return making.reclass(state, numbers, options.class_name)
        case "merge":
            return making.merge(state, numbers)
        case "delete":
            return making.delete(state, one, around=not options.no_object)
        case "accept":
            return making.accept(state, numbers)
    if seen is not None:
        return seen.split(state, one, first_id)
    xyz = state.points_of(one)
    part = making.parts_of(xyz) if options.parts else making.sides_of(xyz, options.plane[:3], options.plane[3:])
    return making.split(state, one, part, first_id, class_of_parts(folder.path, state, one, part))


def _described(edit: Edit, corrected: CorrectedResult) -> str:
    everything = (*corrected.made, *corrected.removed, *corrected.instances)
    names = {one.id: shortened(one.name, _LONGEST) for one in everything}
    objects = ", ".join(f"{mark.id} {names.get(mark.id, '')}".strip() for mark in edit.objects)
    made = "".join(f"; new: {one.id} {one.name}" for one in edit.made)
    if edit.kind == "rename" and not edit.undone:
        number = edit.objects[0].id
        objects, matte = str(number), corrected.names_in_mattes.get(number, edit.name)
        is_last = (number, edit.name) in ((one.id, one.name) for one in corrected.instances)
        made = f"; in Cryptomatte {matte}" if is_last and matte != edit.name else ""  # no commas, and no name twice
    if edit.kind == "reclass" and any(edit.names) and not edit.undone:
        objects = ", ".join(str(mark.id) for mark in edit.objects)
        made = f"; now {', '.join(filter(None, edit.names))}"
    class_id = -(edit.rest or 0) if edit.kind == "assign" else edit.class_id
    to = edit.name or (corrected.classes[class_id].name if class_id in corrected.classes else "")
    return f"{'undone: ' if edit.undone else ''}{edit.kind} {objects}{f' to {to}' if to else ''}{made}"


def _content(corrected: CorrectedResult) -> dict[str, object]:
    objects = [
        {"id": one.id, "name": one.name, "class": one.class_name, "points": one.points,
         "accepted": one.id in corrected.accepted}
        for one in corrected.instances
    ]  # fmt: skip
    removed = [{"id": one.id, "name": one.name, "class": one.class_name} for one in corrected.removed]
    edits = [
        {"uid": edit.uid, "time": edit.time, "kind": edit.kind, "objects": [mark.id for mark in edit.objects],
         "made": [one.id for one in edit.made], "undone": edit.undone,
         "not_applied": corrected.not_applied.get(edit.uid)}
        for edit in corrected.edits
    ]  # fmt: skip
    return {"objects": objects, "removed": removed, "edits": edits}


def _listing(corrected: CorrectedResult) -> str:
    objects = [(one, shortened(one.name, _LONGEST), shortened(one.class_name, _LONGEST)) for one in corrected.instances]
    lines = [f"{one.id:5}  {name}  ({class_name}, {one.points} points)" for one, name, class_name in objects]
    lines += [f"{one.id:5}  {shortened(one.name, _LONGEST)}  (removed)" for one in corrected.removed]
    lines += ["", f"{len(corrected.edits)} edits"]
    for edit in corrected.edits:
        why = corrected.not_applied.get(edit.uid)
        lines.append(f"{edit.time}  {_described(edit, corrected)}" + (f"  NOT APPLIED: {why}" if why else ""))
    return "\n".join(lines)
